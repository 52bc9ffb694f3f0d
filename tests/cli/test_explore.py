"""`aftbed explore`: the exact count, the number that repeats an experiment, the exit codes."""

import json
import re
import shlex
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

import psutil
import pytest
from fakerun import Call, Output

from aftbed.judge.verdict import Breach
from aftbed.runtime.sim.world import Setup
from aftbed.search.explore import EXPLORERS, PLACEMENTS, selected

pytestmark = pytest.mark.simulation

ORDER: Final = ("order", "--ftm", "lfr", "--placement", "replica")
SMALL: Final = ("crash", "--ftm", "lfr", "--placement", "replica", "--count", "1")


@pytest.fixture
def explore(call: Call) -> Call:
    """Call `aftbed explore`."""
    return partial(call, "explore")


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Setup], bool]], None]:
    """Makes experiments break G1."""

    def breaks(which: Callable[[Setup], bool]) -> None:
        def judged(setup: Setup) -> tuple[bool, tuple[Breach, ...]]:
            return False, (Breach("G1", "planted"),) if which(setup) else ()

        monkeypatch.setattr("aftbed.search.explore.judged", judged)

    return breaks


def test_the_count_is_exact(explore: Call) -> None:
    code, out, err = explore(*SMALL)
    number = len(list(selected("crash", ["lfr"], ["replica"], 1).setups()))
    assert (code, err) == (0, "")
    assert re.fullmatch(rf"{number} of {number} survived \(0 unavailable\) in [0-9.]+ s\n", out)


FUNCTION: Final = """
from aftbed.core.application import Characteristics
class Adder:
    characteristics = Characteristics()
    def __init__(self): self.sum = 0
    def execute(self, request):
        self.sum += request[0]
        return b"%d" % self.sum
    def capture(self): return b"%d" % self.sum
    def restore(self, state): RESTORED
"""


def test_a_function_of_the_user_with_its_requests(explore: Call, tmp_path: Path) -> None:
    (tmp_path / "requests.csv").write_text("step:u8\n3\n4\n")
    (tmp_path / "good.py").write_text(FUNCTION.replace("RESTORED", "self.sum = int(state)"))
    (tmp_path / "bad.py").write_text(FUNCTION.replace("RESTORED", "pass"))
    words = ("crash", "--ftm", "pbr", "--placement", "replica", "--requests", tmp_path / "requests.csv")
    code, out, _ = explore(*words, "--app", tmp_path / "good.py:Adder", "--only", "9")
    assert code == 0 and "1 of 1 survived" in out
    code, out, _ = explore(*words, "--app", tmp_path / "bad.py:Adder", "--jobs", "1")
    assert code == 1 and "one_history (G3): request 2: the reply is not the bare server's" in out
    again = re.search(r"repeat +aftbed explore (.*)", out)
    assert again is not None and f"--app {tmp_path}/bad.py:Adder" in again[1]
    code, repeated, _ = explore(*shlex.split(again[1]))
    assert code == 1 and "request 2: the reply is not the bare server's" in repeated


@pytest.mark.parametrize(
    ("body", "seconds_max", "told"),
    [
        ("os.kill(os.getpid(), 9)", 20.0, "has no result, its process has been killed by signal 9"),
        ("exec('while True: pass')", 0.2, "hangs, after 0.2 s there is no result"),
    ],
)
def test_a_function_that_fails_later_is_told_and_ends_no_command(
    body: str, seconds_max: float, told: str, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Later than the requests with which it is tried out."""
    for module in ("cli.sim", "cli.explore", "search.explore"):
        monkeypatch.setattr(f"aftbed.{module}.own_seconds_max", lambda _requests: seconds_max)
    (tmp_path / "requests.csv").write_text("step:u8\n" + "3\n" * 20)
    fails = f"if self.sum >= 57: {body}\n        return b"
    text = FUNCTION.replace("RESTORED", "self.sum = int(state)").replace("return b", fails, 1)
    (tmp_path / "mine.py").write_text(f"import os\n{text}")
    app = ("--app", tmp_path / "mine.py:Adder", "--requests", tmp_path / "requests.csv", "--ftm", "pbr")
    before = psutil.Process().children()
    for command in (("sim",), ("explore", "crash", "--placement", "replica", "--jobs", "1")):
        code, out, err = call(*command, *app)
        assert code == 3 and told in err and err.count("\n") == 1, (code, out, err)
        assert psutil.Process().children() == before


def test_one_process_and_two_count_the_same(explore: Call) -> None:
    found = [json.loads(explore(*SMALL, "--jobs", jobs, "--json")[1]) for jobs in ("1", "2")]
    for document in found:
        assert set(document) == {"explored", "survived", "unavailable", "seconds", "broken"}
        assert document["explored"] == document["survived"] > 20 and document["broken"] == []
    assert found[0]["explored"] == found[1]["explored"]


def test_names_are_separated_by_commas_or_given_one_by_one(explore: Call) -> None:
    small = ("crash", "--placement", "replica", "--count", "1", "--jobs", "1", "--json")
    together, apart = (
        json.loads(explore(*small, *ftms)[1])["explored"]
        for ftms in (("--ftm", "pbr,lfr"), ("--ftm", "pbr", "--ftm", "lfr"))
    )
    assert together == apart == len(list(selected("crash", ("pbr", "lfr"), ("replica",), 1).setups()))


def test_a_broken_experiment_is_printed_with_the_command_that_repeats_it(
    explore: Call, call: Call, broken: Callable[[Callable[[Setup], bool]], None]
) -> None:
    numbered = list(selected("crash", ("lfr",), ("replica",), 1).setups())
    broken(lambda setup: setup == numbered[7])
    code, out, _ = explore(*SMALL, "--jobs", "1")
    assert code == 1
    assert out.startswith("broken: 7: lfr (replica), seed 0, 1 request; ")
    assert "  because    G1: planted" in out
    assert f"{len(numbered) - 1} of {len(numbered)} survived" in out
    (command,) = re.findall(r"repeat +(aftbed .*)", out)
    code, again, _ = call(*shlex.split(command)[1:])
    assert code == 0, "that one is sound"
    assert again.startswith(f"7: lfr (replica), seed 0, 1 request; {numbered[7].dooms[0].brick} dies")
    assert "1 of 1 survived" in again


def test_of_many_broken_experiments_the_first_are_printed_and_json_has_all(
    explore: Call, broken: Callable[[Callable[[Setup], bool]], None]
) -> None:
    broken(lambda setup: True)
    code, out, _ = explore(*SMALL, "--jobs", "1")
    assert code == 1 and len(re.findall("^broken:", out, re.MULTILINE)) == 20
    assert re.search(r"^and [0-9]+ more; --json lists them all$", out, re.MULTILINE)
    document = json.loads(explore(*SMALL, "--jobs", "1", "--json")[1])
    assert len(document["broken"]) == document["explored"] and document["survived"] == 0
    first = document["broken"][0]
    assert first["number"] == 0 and first["breaches"] == ["G1: planted"]
    assert first["command"].startswith(
        "aftbed explore crash --ftm lfr --placement replica --count 1 --only 0"
    )


@pytest.mark.parametrize(
    ("words", "experiment"),
    [
        (("adapt", "--ftm", "pbr,pbr+tr", "--only", "100"), "to pbr+tr at request 4"),
        (("pairs", "--ftm", "lfr", "--only", "4"), "crash client after 1.5ms"),
    ],
)
def test_one_experiment_by_its_number(explore: Call, words: tuple[str, ...], experiment: str) -> None:
    code, out, _ = explore(*words)
    assert code == 0
    assert experiment in out.splitlines()[0] and "1 of 1 survived" in out


@pytest.mark.parametrize("explorer", EXPLORERS)
def test_a_selection_without_names_has_all_mechanisms_and_placements(explorer: str) -> None:
    whole = selected(explorer, (), (), 1)
    assert whole.placements == PLACEMENTS and whole.ftms == EXPLORERS[explorer].ftms()


def test_adaptations_from_and_to_a_mechanism_of_one_replica(explore: Call) -> None:
    """Also those that stage what watches a backup, which is explored without being named."""
    assert selected("adapt", (), ()).ftms == ("pbr", "lfr", "tr", "pbr+tr", "lfr+tr")
    numbered = list(selected("adapt", ("tr", "pbr"), ("process",)).setups())
    watched = next(n for n, one in enumerate(numbered) if str(one.faults[0]).startswith("crash b/watchdog'"))
    code, out, _ = explore("adapt", "--ftm", "tr,pbr", "--placement", "process", "--only", str(watched))
    assert code == 0 and "1 of 1 survived" in out
    code, out, _ = explore("adapt", "--ftm", "assert,pbr", "--placement", "replica", "--only", "3")
    assert code == 0 and "assert (replica)" in out
    code, _, err = explore("adapt", "--ftm", "none,pbr")
    assert code == 2 and "unknown FTM 'none'" in err


# -- order


def test_every_order_is_counted_up_to_the_bound(explore: Call) -> None:
    code, out, _ = explore(*ORDER, "--count", "2", "--bound", "20")
    lines = out.splitlines()
    assert code == 0
    assert lines[0] == "all 2 orders (3 cut): lfr (replica), seed 0, 1 request; pages of 16 bytes"
    assert lines[1] == "all 6 orders (13 cut): lfr (replica), seed 0, 2 requests; pages of 16 bytes"
    assert all(line.startswith("at least ") for line in lines[2:-1]), "20 runs are not enough with a crash"
    assert "all orders of 2 of " in lines[-1] and "the others up to 20 runs each" in lines[-1]


def test_the_orders_as_json(explore: Call) -> None:
    code, out, _ = explore(*ORDER, "--count", "1", "--bound", "5", "--json")
    found = json.loads(out)
    assert code == 0 and found["explored"] == found["survived"] > 0
    assert (found["bound"], found["complete"], found["broken"]) == (5, 1, [])


# -- bad input


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("crash", "--count", "0"), ("--count 0", "1 to 1000")),
        (("crash", "--count", "-3"), ("--count -3",)),
        (("crash", "--jobs", "0"), ("--jobs 0", "1 to 256")),
        (("crash", "--ftm", "prb"), ("unknown FTM 'prb'", "did you mean 'pbr'")),
        (("crash", "--ftm", "pbr,"), ("unknown FTM ''",)),
        (("crash", "--ftm", "tr"), ("unknown FTM 'tr'", "lfr+tr")),
        (("adapt", "--ftm", "none,pbr"), ("unknown FTM 'none'",)),
        (("adapt", "--ftm", "pbr"), ("--ftm pbr", "name two")),
        (("pairs", "--placement", "single"), ("unknown placement 'single'", "process, replica")),
        ((*SMALL, "--only", "99999"), ("--only 99999", "0 to ")),
        ((*SMALL, "--only", "-1"), ("--only -1",)),
        ((*ORDER, "--bound", "0"), ("--bound 0: 1 to 10000000 are allowed",)),
        ((*ORDER, "--count", "0"), ("--count 0: 1 to 1000 are allowed",)),
        (("order", "--ftm", "lfrr"), ("unknown FTM 'lfrr'",)),
    ],
)
def test_options_that_are_refused(
    refused: Output, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    error = refused("explore", *arguments)
    assert all(word in error for word in words), error


class Interrupted:
    """An exploration at whose first result Ctrl-C is pressed."""

    def __iter__(self) -> "Interrupted":
        return self

    def __next__(self) -> None:
        raise KeyboardInterrupt

    def close(self) -> None:
        """As a generator has it."""


def test_ctrl_c_ends_every_explorer_with_130(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, command in (("explore_all", "crash"), ("explore_orders", "order")):
        monkeypatch.setattr(f"aftbed.cli.explore.{name}", lambda *_, **__: Interrupted())
        words = ("explore", command, "--ftm", "pbr", "--placement", "process", "--count", "1")
        code, out, err = call(*words)
        assert code == 130 and err.startswith("aftbed: interrupted: 0 of ") and "nothing is kept" in err
        assert out.splitlines()[-1].startswith("0 of 0 ")
