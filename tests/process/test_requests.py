"""Real runs of a user's requests, with the replies that are expected to them."""

import json
import stat
import struct
from pathlib import Path
from typing import Final

import pytest
from liveruns import Home, aftbed, home

from aftbed.core.journal import EntryKind
from aftbed.judge.record import read_record

pytestmark = pytest.mark.process

__all__ = ["home"]

FILE_REQUESTS: Final = 40
COUNT: Final = 60  # the first ones come again
MEAN: Final = """
import struct

from aftbed.core.application import Characteristics
from aftbed.core.errors import PeerError


class Mean:
    characteristics = Characteristics()

    def __init__(self):
        self.count, self.total = 0, 0.0

    def execute(self, request):
        if len(request) != 16:
            raise PeerError("16 bytes are required")
        _, distance = struct.unpack("<Qd", request)
        self.count += 1
        self.total += distance
        return struct.pack("<Id", self.count, self.total / self.count)

    def capture(self):
        return struct.pack("<Id", self.count, self.total)

    def restore(self, state):
        self.count, self.total = struct.unpack("<Id", state)
"""
DISTANCES: Final = [50.0 - number / 8 for number in range(FILE_REQUESTS)]
CODEC: Final = "t_us:u64,distance:f64"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With the function, its requests as a CSV, and the replies to them as JSON lines."""
    (tmp_path / "mean.py").write_text(MEAN)
    rows = (f"{20_000 * number},{distance}\n" for number, distance in enumerate(DISTANCES))
    (tmp_path / "requests.csv").write_text(f"{CODEC}\n{''.join(rows)}")
    sent = [DISTANCES[number % FILE_REQUESTS] for number in range(COUNT)]
    means = [{"n": number, "mean": sum(sent[:number]) / number} for number in range(1, COUNT + 1)]
    header = {"codec": "n:u32,mean:f64", "tolerance": 1e-6}
    (tmp_path / "expected.jsonl").write_text("".join(json.dumps(one) + "\n" for one in (header, *means)))
    return tmp_path


def words(folder: Path) -> tuple[str, ...]:
    files = ("--requests", str(folder / "requests.csv"), "--expect", str(folder / "expected.jsonl"))
    return ("run", "--app", f"{folder / 'mean.py'}:Mean", *files, "--count", str(COUNT))


def test_requests_of_a_file_get_the_expected_replies_whatever_dies(home: Home, folder: Path) -> None:
    record = folder / "record"
    faults = ("crash primary at server.exit nth 20", "crash client at request.sent nth 45")
    injected = [word for fault in faults for word in ("--inject", fault)]
    done = aftbed(*words(folder), "--rate", "1000", *injected, "--record", record)
    assert done.code == 0, done.out + done.err
    assert "expected_replies pass" in done.out and "60 sent, 60 answered" in done.out
    sent = [e.payload for e in read_record(record).history.dialogue if e.kind is EntryKind.SENT]
    places = (number % FILE_REQUESTS for number in range(COUNT))
    assert sent == [struct.pack("<Qd", 20_000 * place, DISTANCES[place]) for place in places]
    sealed = json.loads((record / "seal.json").read_text())["files"]
    for name in ("requests.msgpack", "expected.msgpack"):
        assert name in sealed and stat.S_IMODE((record / name).stat().st_mode) == 0o600
    for name in ("requests.csv", "expected.jsonl"):
        (folder / name).unlink()
    judged = aftbed("check", record)
    assert judged.code == 0 and "expected_replies pass" in judged.out, judged.out + judged.err


def test_a_reply_that_is_not_the_expected_one_fails_the_run(home: Home, folder: Path) -> None:
    path = folder / "expected.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    lines[7] = '{"n": 7, "mean": 49.5}\n'
    path.write_text("".join(lines))
    done = aftbed(*words(folder), "--placement", "replica", "--json")
    verdict = done.verdict()
    assert (done.code, verdict.checks["expected_replies"], verdict.checks["one_history"]) == (
        1,
        "fail",
        "pass",
    )
    assert verdict.reasons == [
        "expected_replies: request 7: mean: found 49.625, expected 49.5 (tolerance 1e-06)"
    ]


def test_a_file_that_was_cut_off_starts_nothing(home: Home, folder: Path) -> None:
    path = folder / "requests.csv"
    path.write_bytes(path.read_bytes()[:-3])
    done = aftbed(*words(folder), "--record", folder / "record")
    assert (done.code, done.out) == (2, "")
    assert done.err.startswith(f"aftbed: error: {path}: line 41: cut off: found '780000,45")
    assert not (folder / "record").exists()
    assert home.left() == []
