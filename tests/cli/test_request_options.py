"""`--requests` and what goes with it: what is refused before a run starts, and what the simulator does."""

import json
import re
import shlex
from pathlib import Path
from typing import Final

import pytest
from fakerun import Call, Output
from msgspec.structs import replace

from aftbed.core.errors import ConfigError
from aftbed.functions.request_file import GivenRequests
from aftbed.judge.simulated import record_of
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.search.agreement import setup_of
from aftbed.vehicle.aeb.function import default_application, sample_requests

COUNT: Final = 6
MAKE: Final = """
from aftbed.core.errors import ConfigError
from aftbed.functions.request_file import GivenRequests
from aftbed.judge.simulated import record_of
from aftbed.runtime.sim.world import Setup, simulate
from aftbed.search.agreement import setup_of
from aftbed.vehicle.aeb.function import sample_requests

def make(seed):
    with open({calls!r}, "a") as calls:
        calls.write(f"{{seed}} ")
    yield from sample_requests(seed, 1000)

def fails(seed):
    raise ValueError("no fuel")
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with requests, the right replies, and a function that makes others."""
    requests, bare = sample_requests(3, COUNT), default_application()
    replies = [bare.execute(request) for request in requests]
    for name, lines in (
        ("requests.csv", requests),
        ("expected.csv", replies),
        ("more.csv", [*replies, b"x"]),
    ):
        (tmp_path / name).write_text("".join(f"{line}\n" for line in ("hex", *(one.hex() for one in lines))))
    wrong = [*replies[:3], b"wrong", *replies[4:]]
    (tmp_path / "wrong.jsonl").write_text("".join(json.dumps({"hex": one.hex()}) + "\n" for one in wrong))
    (tmp_path / "torn.csv").write_text("hex\n00\n0")
    (tmp_path / "mine.py").write_text(MAKE.format(calls=str(tmp_path / "calls")))
    monkeypatch.chdir(tmp_path)
    return tmp_path


BOTH: Final[list[tuple[str, str]]] = [  # the options, and the error
    ("--requests torn.csv", "torn.csv: line 3: cut off: found '0' without a newline behind it"),
    ("--requests gone.csv", "gone.csv: no such file"),
    (
        "--requests mine.py:make",
        "--requests mine.py:make: a function makes as many as are asked for: give --count",
    ),
    ("--requests mine.py:make --count 100001", "--count 100001: 1 to 100000 are allowed"),
    ("--requests mine.py:fails --count 5", "mine.py:fails: raised ValueError: no fuel"),
    ("--requests requests.csv --count 0", "--count 0: 1 to "),
    ("--requests requests.csv --expect gone.csv", "gone.csv: cannot be read"),
    (
        "--requests requests.csv --expect more.csv",
        "--expect more.csv: 7 replies, and 6 requests are sent; as many are required",
    ),
    (
        "--requests requests.csv --count 9 --expect more.csv",
        "--expect more.csv: 7 replies, and 9 requests are sent; as many are required",
    ),
    ("--requests requests.csv --tolerance 1", "--tolerance is about --expect: give it too"),
    (
        "--requests requests.csv --expect expected.csv --tolerance 1",
        "expected.csv: has no codec, so --tolerance is about no number: leave it out",
    ),
]
OF_A_RUN: Final[list[tuple[str, str]]] = [
    ("--count 5 --rate 5", "only with --requests: leave out --count, --rate"),
    ("--load 5 --expect expected.csv", "only with --requests: leave out --expect"),
    ("--requests requests.csv --load 5", "no car, no bus and no other load: leave out --load"),
    ("--requests requests.csv --replay x.log --map m --dbc d", "leave out --replay, --dbc, --map"),
    (
        "--requests requests.csv --scenario ccrs-20 --pace max --brake-policy hold --bus-open --bus-port 5",
        "leave out --scenario, --pace, --brake-policy, --bus-port, --bus-open",
    ),
    ("--requests requests.csv --rate -1", "--rate -1.0: 0 to 100000 a second are allowed"),
    ("--requests requests.csv --rate nan", "--rate nan: 0 to 100000 a second are allowed"),
    (
        "--requests requests.csv --inject 'corrupt bus RADAR_TRACK signal RANGE=300 crc good permanent'",
        "a run of --requests has no bus",
    ),
    ("--requests requests.csv --inject 'crash primary when ttc < 1.2'", "a run of --requests has none"),
]
OF_THE_SIMULATOR: Final[list[tuple[str, str]]] = [
    ("--expect expected.csv", "--expect and --tolerance are about --requests: give it too"),
    ("--requests requests.csv --scenario ccrs-20", "the car makes the requests; leave out --requests"),
    ("--requests requests.csv --swarm", "leave out --requests"),
]


@pytest.mark.parametrize(
    ("command", "options", "words"),
    [(command, *case) for command in ("run", "sim") for case in BOTH]
    + [("run", *case) for case in OF_A_RUN]
    + [("sim", *case) for case in OF_THE_SIMULATOR],
)
def test_options_that_do_not_go_together_start_nothing(
    folder: Path, refused: Output, command: str, options: str, words: str
) -> None:
    assert words in refused(command, *shlex.split(options))


def test_a_simulated_run_sends_the_requests_of_a_file(folder: Path, call: Call) -> None:
    fault = ("--inject", "crash primary at server.exit nth 3")
    code, out, err = call("sim", "--requests", "requests.csv", "--expect", "expected.csv", *fault)
    assert (code, err) == (0, "")
    assert f"pbr (process), seed 0, {COUNT} requests of {folder}/requests.csv; crash primary" in out
    assert f"{COUNT} sent, {COUNT} answered" in out and "expected_replies pass" in out


def test_a_reply_of_a_simulated_run_that_is_not_expected_fails_it(folder: Path, call: Call) -> None:
    code, out, _ = call("sim", "--requests", "requests.csv", "--expect", "wrong.jsonl")
    reason = r"expected_replies \(G8\): request 4: found \d+ bytes, expected 5 bytes"
    assert code == 1 and re.search(f"because +{reason}", out)
    *_, shrunk = (line.split("repeat", 1)[1].split() for line in out.splitlines() if "  repeat " in line)
    assert shrunk[shrunk.index("--count") + 1] == "4", "the first that shows it"
    code, out, _ = call(*shrunk[1:])
    assert code == 1 and re.search(reason, out)


def test_a_reply_that_never_came_is_no_pass(folder: Path, call: Call) -> None:
    lost = ("--ftm", "none", "--inject", "crash primary at server.exit nth 3")
    code, out, _ = call("sim", "--requests", "requests.csv", "--expect", "expected.csv", *lost)
    assert code == 3
    assert f"expected_replies: no reply to {COUNT - 2} of {COUNT} requests, the first is request 3" in out


def test_fewer_requests_than_replies_are_compared_where_they_are_asked_for(folder: Path, call: Call) -> None:
    code, out, _ = call("sim", "--requests", "requests.csv", "--count", "2", "--expect", "expected.csv")
    assert code == 0 and "2 sent, 2 answered" in out and "expected_replies pass" in out


def test_a_function_makes_the_requests_of_each_seed(folder: Path, call: Call) -> None:
    words = ("sim", "--requests", "mine.py:make", "--count", "4")
    code, out, _ = call(*words, "--seeds", "7..9", "--jobs", "1")
    assert code == 0 and "3 of 3 survived" in out
    assert (folder / "calls").read_text() == "7 8 9 "


def test_a_failure_with_the_requests_of_a_function_is_shrunk_and_repeated(folder: Path, call: Call) -> None:
    words = ("--requests", "mine.py:make", "--seed", "3", "--expect", "wrong.jsonl")
    code, out, _ = call("sim", *words, "--count", str(COUNT), "--json")
    document = json.loads(out)
    assert code == 1 and " --count 4 " in document["shrunk"], document
    code, out, _ = call(*shlex.split(document["shrunk"])[1:])
    assert code == 1 and "expected_replies (G8): request 4: " in out


def test_a_record_is_compared_with_simulations_of_its_own_requests() -> None:
    given = GivenRequests("mine.csv", tuple(sample_requests(3, 2)))
    record = record_of(simulate(Setup(count=3, given=given)))
    assert setup_of(record) == Setup(count=3, given=given)
    with pytest.raises(ConfigError, match="its requests are missing, so it is not simulated"):
        setup_of(replace(record, given=None))
