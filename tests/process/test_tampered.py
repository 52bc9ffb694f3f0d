"""A record that was changed, cut or mixed with another one never passes, not even with a new seal.

One run under PBR, with a crash and an adaptation, leaves the record. Each change is made to a copy.
"""

import json
import shutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final

import pytest
from liveruns import aftbed

from aftbed.core.errors import ConfigError
from aftbed.core.events import Event
from aftbed.core.journal import DROPPED_OFFSET, ENTRY, HEADER_BYTES, RECORD, EntryKind, entries_in, records
from aftbed.judge.listed import VERDICT_NAME
from aftbed.judge.record import read_record
from aftbed.judge.verdict import judge
from aftbed.runtime.unix import seal

pytestmark = pytest.mark.process

REQUESTS: Final = 160  # at 200/s: on a busy machine, too, the adaptation begins behind the failover, and ends
CRASH: Final = "crash primary at server.exit nth 20"
NS_PER_S: Final = 10**9
DIALOGUE: Final = "client.1.dialogue"

Tamper = Callable[[Path], None]


@cache
def recorded(path: Path, seed: int) -> Path:
    """The record of a run that passed, made once for all tests."""
    arguments = ("--load", f"{REQUESTS}@200", "--inject", CRASH, "--adapt", "to lfr at request 100")
    done = aftbed("run", *arguments, "--seed", str(seed), "--record", path)
    assert done.code == 0, done.out + done.err
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """For the records."""
    return tmp_path_factory.mktemp("records")


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Iterator[Path]:
    """A record that may be changed."""
    path = tmp_path / "copy"
    shutil.copytree(recorded(folder / "whole", 1), path)
    yield path
    shutil.rmtree(path)


@pytest.fixture
def other(folder: Path) -> Path:
    """The same run of another seed."""
    return recorded(folder / "other", 2)


# -- what is done to it ---------------------------------------------------------------------------


def edited(name: str, change: Callable[[dict[str, Any]], object]) -> Tamper:
    """One of the JSON files."""

    def tamper(record: Path) -> None:
        found = json.loads((record / name).read_text())
        change(found)
        (record / name).write_text(json.dumps(found))

    return tamper


def without(name: str, key: str) -> Tamper:
    return edited(name, lambda found: found.pop(key))


def set_to(name: str, **values: object) -> Tamper:
    return edited(name, lambda found: found.update(values))


def removed(pattern: str) -> Tamper:
    return on_files(pattern, Path.unlink)


def on_files(pattern: str, change: Callable[[Path], object]) -> Tamper:
    """Each file of the journal folder that the pattern names; there must be one."""

    def tamper(record: Path) -> None:
        found = list((record / "journal").glob(pattern))
        assert found, pattern
        for path in found:
            change(path)

    return tamper


def emptied(pattern: str) -> Tamper:
    return on_files(pattern, lambda path: path.write_bytes(b""))


def cut_to_header(pattern: str) -> Tamper:
    return on_files(pattern, lambda path: path.write_bytes(path.read_bytes()[:HEADER_BYTES]))


def zeroed_header(pattern: str) -> Tamper:
    return on_files(pattern, lambda p: p.write_bytes(bytes(HEADER_BYTES) + p.read_bytes()[HEADER_BYTES:]))


def packed(path: Path) -> list[bytes]:
    """The records of a journal, or the entries of a dialogue, as they stand in the file."""
    data = path.read_bytes()
    if path.suffix == ".journal":
        count = len(list(records(data)))
        return [data[at : at + RECORD.size] for at in _steps(count, RECORD.size)]
    found, at = [], HEADER_BYTES
    for entry in entries_in((data[HEADER_BYTES:],)):
        size = ENTRY.size + len(entry.payload)
        found.append(data[at : at + size])
        at += size
    return found


def _steps(count: int, size: int) -> range:
    return range(HEADER_BYTES, HEADER_BYTES + count * size, size)


def changed(pattern: str, change: Callable[[list[bytes]], list[bytes]]) -> Tamper:
    """Its records or entries."""

    def tamper(path: Path) -> None:
        data, parts = path.read_bytes(), packed(path)
        made = b"".join(change(parts))
        assert made != b"".join(parts), "nothing was changed"
        path.write_bytes((data[:HEADER_BYTES] + made).ljust(len(data), b"\0"))

    return on_files(pattern, tamper)


def with_time(part: bytes, change: Callable[[int], int]) -> bytes:
    return change(int.from_bytes(part[:8], "little")).to_bytes(8, "little") + part[8:]


def is_answer(part: bytes) -> bool:
    return bool(ENTRY.unpack_from(part)[4] == EntryKind.ANSWERED)


def with_epoch(part: bytes, epoch: int) -> bytes:
    t_ns, number, length, _, kind = ENTRY.unpack_from(part)
    return ENTRY.pack(t_ns, number, length, epoch, kind) + part[ENTRY.size :]


def first_answer_moved(parts: list[bytes]) -> list[bytes]:
    at = next(number for number, part in enumerate(parts) if is_answer(part))
    return [parts[at], *parts[:at], *parts[at + 1 :]]


def answers_exchanged(parts: list[bytes]) -> list[bytes]:
    first, second = [number for number, part in enumerate(parts) if is_answer(part)][5:7]
    swapped = list(parts)
    swapped[first], swapped[second] = parts[second], parts[first]
    return swapped


def late_answer(parts: list[bytes]) -> list[bytes]:
    at = [number for number, part in enumerate(parts) if is_answer(part)][10]
    return [*parts[:at], with_time(parts[at], lambda t_ns: t_ns + 60 * NS_PER_S), *parts[at + 1 :]]


def stale_epoch(parts: list[bytes]) -> list[bytes]:
    at = [number for number, part in enumerate(parts) if is_answer(part)][-1]
    return [*parts[:at], with_epoch(parts[at], 1), *parts[at + 1 :]]


def payload_flipped(parts: list[bytes]) -> list[bytes]:
    """Of the first request."""
    at = next(n for n, part in enumerate(parts) if ENTRY.unpack_from(part)[4] == EntryKind.SENT)
    return [*parts[:at], parts[at][:-1] + bytes([parts[at][-1] ^ 1]), *parts[at + 1 :]]


def times_shuffled(parts: list[bytes]) -> list[bytes]:
    times = [int.from_bytes(part[:8], "little") for part in reversed(parts)]
    return [with_time(part, lambda _, t_ns=t_ns: t_ns) for part, t_ns in zip(parts, times, strict=True)]  # type: ignore[misc]


def without_exit(parts: list[bytes]) -> list[bytes]:
    """Without the fifth execution."""
    executed = [n for n, part in enumerate(parts) if RECORD.unpack_from(part)[4] == Event.SERVER_EXIT.code]
    return [part for number, part in enumerate(parts) if number != executed[5]]


def lost_records(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[DROPPED_OFFSET] = 3
    path.write_bytes(data)


def no_leader(found: dict[str, Any]) -> None:
    found["hosted"]["leader"] = found["leader"] = ""


def other_receipt(found: dict[str, Any]) -> None:
    found["faults"][0]["fault"] = "crash proxy"


def other_states(found: dict[str, Any]) -> None:
    found["states"]["b"] = "0" * 16


def ended_before_its_last_record(record: Path) -> None:
    last_ns = max(read_record(record).history.times())
    set_to("end.json", ended_ns=last_ns - 1)(record)


def without_brick(found: dict[str, Any]) -> None:
    found["hosted"]["bricks"].pop()


TAMPERS: Final[dict[str, Tamper]] = {
    "all journals of servers deleted": removed("*.server.*.journal"),
    "all journals of servers emptied": emptied("*.server.*.journal"),
    "all journals of servers cut to their header": cut_to_header("*.server.*.journal"),
    "one server's journal deleted": removed("a.server.1.journal"),
    "one server's header zeroed": zeroed_header("a.server.1.journal"),
    "an execution missing": changed("a.server.1.journal", without_exit),
    "the server's records in reverse order": changed("a.server.1.journal", lambda parts: parts[::-1]),
    "the server's times shuffled": changed("a.server.1.journal", times_shuffled),
    "half of a server's journal": changed("a.server.1.journal", lambda parts: parts[: len(parts) // 2]),
    "records found no room": on_files("a.server.1.journal", lost_records),
    "the proxy's journal deleted": removed("proxy.1.journal"),
    "the proxy's journal emptied": emptied("proxy.1.journal"),
    "the proxy's journal halved": changed("proxy.1.journal", lambda parts: parts[: len(parts) // 2]),
    "the proxy's header zeroed": zeroed_header("proxy.1.journal"),
    "the client's journal deleted": removed("client.1.journal"),
    "the supervisor's journal deleted": removed("supervisor.1.journal"),
    "a watchdog's journal deleted": removed("b.watchdog.1.journal"),
    "recovery's journal deleted": removed("recovery.1.journal"),
    "an unknown event": changed("proxy.1.journal", lambda parts: [parts[0][:28] + b"\xff\0\0\0", *parts[1:]]),
    "the dialogue deleted": removed(DIALOGUE),
    "the dialogue emptied": emptied(DIALOGUE),
    "the dialogue cut in the middle": changed(DIALOGUE, lambda parts: parts[: len(parts) // 2]),
    "the dialogue cut to its header": cut_to_header(DIALOGUE),
    "the last request and its reply removed": changed(DIALOGUE, lambda parts: parts[:-2]),
    "the last reply removed": changed(DIALOGUE, lambda parts: parts[:-1]),
    "the first request and its reply removed": changed(DIALOGUE, lambda parts: parts[2:]),
    "a reply twice": changed(DIALOGUE, lambda parts: [*parts, parts[-1]]),
    "a reply before its request": changed(DIALOGUE, first_answer_moved),
    "two replies in the other order": changed(DIALOGUE, answers_exchanged),
    "a reply a minute late": changed(DIALOGUE, late_answer),
    "a stale epoch": changed(DIALOGUE, stale_epoch),
    "a bit of a request": changed(DIALOGUE, payload_flipped),
    "the times of the dialogue shuffled": changed(DIALOGUE, times_shuffled),
    "no receipts": set_to("end.json", faults=[]),
    "no key of receipts": without("end.json", "faults"),
    "the receipt of another fault": edited("end.json", other_receipt),
    "a receipt that never fired": edited("end.json", lambda f: f["faults"][0].update(receipt="armed")),
    "a receipt that is none": edited("end.json", lambda f: f["faults"][0].update(receipt="fine")),
    "the faults removed from run.json": set_to("run.json", faults=[]),
    "faults and receipts removed": lambda record: (
        set_to("run.json", faults=[])(record),
        set_to("end.json", faults=[])(record),
    )[0],
    "the adaptations' outcomes deleted": lambda record: (record / "adaptations.jsonl").unlink(),
    "another adaptation asked for": edited(
        "run.json", lambda f: f["adaptations"].append(f["adaptations"][0])
    ),
    "more requests asked for": edited("run.json", lambda f: f["work"].update(count=REQUESTS + 1)),
    "fewer requests asked for": edited("run.json", lambda f: f["work"].update(count=REQUESTS - 1)),
    "another seed": set_to("run.json", seed=99),
    "another mechanism": set_to("run.json", ftm="lfr+tr"),
    "a later start": edited("run.json", lambda f: f.update(started_ns=f["started_ns"] + NS_PER_S)),
    "no end": lambda record: (record / "end.json").unlink(),
    "an end before the last record": ended_before_its_last_record,
    "an end without what was left": without("end.json", "left"),
    "an end with what was left": set_to("end.json", left=["a/server (77)"]),
    "an end without states": without("end.json", "states"),
    "an end with no state": set_to("end.json", states={}),
    "an end with states that differ": edited("end.json", other_states),
    "an end without a graph": without("end.json", "hosted"),
    "an end with half a graph": edited("end.json", without_brick),
    "an end without a leader": edited("end.json", no_leader),
    "an end that was lost": set_to("end.json", lost=True),
    "an end with something unfinished": set_to("end.json", unfinished=["failover"]),
    "an end with another count of requests": edited("end.json", lambda f: f["client"].update(sent=7)),
    "the end cut off": lambda record: (
        (record / "end.json").write_bytes((record / "end.json").read_bytes()[:-9]) and None
    ),
}


def verdict_of(record: Path) -> str:
    try:
        return judge(read_record(record)).verdict
    except ConfigError:
        return "refused"


def test_as_it_is_it_passes(copy: Path) -> None:
    assert verdict_of(copy) == "pass"


@pytest.mark.parametrize("name", TAMPERS)
def test_a_changed_record_never_passes(copy: Path, name: str) -> None:
    TAMPERS[name](copy)
    seal.write(copy)
    assert verdict_of(copy) != "pass", name


def test_a_flipped_byte_or_a_missing_file_is_told_by_the_seal(copy: Path) -> None:
    evidence = [path for path in copy.rglob("*") if path.is_file() and path.name != VERDICT_NAME]
    for path in sorted(evidence):  # the verdict of before is none: the record is judged anew
        whole = path.read_bytes()
        for at in (0, len(whole) - 1) if whole else ():
            path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
            assert verdict_of(copy) != "pass", path
        path.unlink()
        assert verdict_of(copy) != "pass", path
        path.write_bytes(whole)
    assert verdict_of(copy) == "pass"


def test_what_the_seal_tells(copy: Path) -> None:
    with (copy / "events.jsonl").open("ab") as file:
        file.write(b"{}\n")
    (copy / "processes.log").unlink()
    (copy / "notes.txt").write_text("a file beside the record changes nothing")
    reasons = judge(read_record(copy)).reasons
    assert reasons == [
        "sources_agree: events.jsonl was changed since the record was sealed",
        "sources_agree: processes.log was removed since the record was sealed",
    ]
    (copy / seal.NAME).unlink()
    verdict = judge(read_record(copy))
    assert verdict.verdict == "inconclusive"
    assert verdict.reasons == [
        "sources_agree: the record has no seal.json: its command did not live to seal it, or it was removed"
    ]


@pytest.mark.parametrize(
    "pattern", [DIALOGUE, "*.server.*.journal", "proxy.1.journal", "supervisor.1.journal"]
)
def test_a_file_of_another_run_does_not_pass(copy: Path, other: Path, pattern: str) -> None:
    for path in (other / "journal").glob(pattern):
        shutil.copy(path, copy / "journal" / path.name)
    seal.write(copy)
    assert verdict_of(copy) != "pass"


@pytest.mark.parametrize("name", ["run.json", "end.json"])
def test_a_document_of_another_run_does_not_pass(copy: Path, other: Path, name: str) -> None:
    shutil.copy(other / name, copy / name)
    seal.write(copy)
    assert verdict_of(copy) != "pass"
