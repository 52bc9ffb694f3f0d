"""Golden dialogues: what a person would draw on the whiteboard, run against the bricks.

A file in `tests/golden` holds commands and, behind `>`, all that follows from each: the messages that were
put into channels, in their order, and what the runtime did. `pytest --rewrite` writes what follows anew;
a change is committed only when it is understood.

    ftm EXPRESSION                           deploy
    request 1 d=40 [until LINK Message(1)]   the next request, with its payload; stop after that message
    run [until ...]                          go on
    crash primary|backup|BRICK               it is gone, and whatever it had still to do
    accuse BRICK                             its Watchdog believes so; it lives
    replace BRICK                            of no replica: dead, and another in its place
    flip REPLICA NTH result|state BIT        in its nth execution from now on, in the last byte of that
    check PROMISE ...                        the checkers of core, over all that happened
"""

import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from counting import Counting
from harness import World
from spoiling import Flips, Hit

from aftbed.core import check
from aftbed.core.fault import Place

GOLDEN: Final = Path(__file__).parents[1] / "golden"
COLUMNS: Final = 106


class Stage:
    """Runs the commands of one file."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self._flips = Flips()
        self._world: World | None = None

    @property
    def world(self) -> World:
        assert self._world is not None, "`ftm EXPRESSION` comes first"
        return self._world

    def obey(self, line: str) -> list[str]:
        """What follows from one command."""
        command, _, rest = line.partition(" ")
        words, _, stop = rest.partition(" until ")
        self.said.clear()
        match command:
            case "ftm":
                self._world = World(expression=words)
                self._world.saying = self.said.append
                self._world.spoil = self._flips
            case "request":
                number, _, payload = words.partition(" ")
                assert int(number) == len([e for e in self.world.dialogue if e.kind == 1]) + 1, "the next id"
                self.world.submit(payload.encode())
                self.world.run(stop)
            case "run":
                self.world.run(rest.removeprefix("until "))
            case "crash":
                self.world.crash(self._name(words))
            case "accuse":
                self.world.accuse(words)
            case "replace":
                self.world.replace(words)
            case "flip":
                replica, nth, place, bit = words.split()
                self._flips.plan(replica, int(nth), Hit(Place(place), int(bit)))
            case "check":
                self._check(words.split())
            case _:
                raise AssertionError(f"no such command: {line}")
        return textwrap.wrap("  ".join(s.replace(" ", "\x00") for s in self.said), COLUMNS)

    def _name(self, words: str) -> str:
        return {"primary": self.world.leader, "backup": self.world.backup}.get(words, words)

    def _check(self, promises: list[str]) -> None:
        history = self.world.history()
        for promise in promises:
            judge = getattr(check, promise)
            found = judge(history, Counting()) if promise == "one_history" else judge(history)
            self.said.append(f"{promise}: {'; '.join((found.finding, *found.reasons))}")


def played(text: str) -> Iterator[str]:
    """The lines of a golden file as they should be."""
    stage = Stage()
    for line in text.splitlines():
        if line.startswith("> "):
            continue
        yield line
        if line and not line.startswith("#"):
            yield from (f"> {said}".replace("\x00", " ") for said in stage.obey(line))


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.txt")), ids=lambda p: p.stem)
def test_dialogue(path: Path, rewrite: bool) -> None:
    text = path.read_text()
    found = "\n".join(played(text)) + "\n"
    if rewrite:
        path.write_text(found)
    assert found == path.read_text()


def test_the_dialogues_are_there() -> None:
    names = {path.stem for path in GOLDEN.glob("*.txt")}
    assert names >= {
        "assert_refused",
        "lfr_crash_after_notification",
        "lfr_crash_before_execution",
        "lfr_crash_before_forward",
        "lfr_crash_of_follower",
        "lfr_divergence",
        "lfr_normal",
        "lfr_tr",
        "none_normal",
        "pbr_assert_refused",
        "pbr_crash_after_checkpoint",
        "pbr_crash_before_checkpoint",
        "pbr_crash_of_backup",
        "pbr_duplicate_request",
        "pbr_false_alarm",
        "pbr_normal",
        "pbr_tr",
        "pbr_tr_no_majority",
        "tr_corrected",
        "tr_no_majority",
        "tr_normal",
    }
