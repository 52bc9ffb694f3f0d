"""Golden dialogues: what a person would draw on a whiteboard, played by the simulator and the real executive.

A file in `tests/golden` holds commands and, behind `>`, all that follows from each: a line for each thing
that happens, in order. `pytest tests/sim/test_golden.py --rewrite` writes what follows anew; a change is
committed only when it is understood.

    ftm EXPRESSION                          deploy
    request 1 d=40 [until WORDS]            the next request; all up to the one behind it, or to such a line
    run [until WORDS]                       go on, up to there
    inject FAULT                            in the words of `aftbed inject`
    adapt EXPRESSION                        ask for that mechanism
    mistake NODE                            its Watchdog takes it for dead; it lives
    end                                     come to rest, and judge all that has happened
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from counting import Counting
from whiteboard import Whiteboard

from aftbed.core.messages import Goal, NodeDied
from aftbed.inject.model import parse
from aftbed.judge import checks
from aftbed.judge.reference import reference_run
from aftbed.runtime.sim.node_io import SimNode
from aftbed.runtime.sim.processes import SimProcess

GOLDEN: Final = Path(__file__).parents[1] / "golden"
ARMED_NS: Final = 1_000_000  # a fault is in its place long before
MECHANISMS: Final = ("pbr", "lfr", "tr", "pbr_tr", "lfr_tr", "pbr_assert", "lfr_assert", "pbr_sup")
WAYS: Final = (
    ("pbr", "lfr"),
    ("lfr", "pbr"),
    ("pbr", "pbr_tr"),
    ("pbr_tr", "pbr"),
    ("lfr", "lfr_tr"),
    ("lfr_tr", "lfr"),
)


class Stage:
    """Plays the commands of one file, whose requests are known from the start."""

    def __init__(self, payloads: list[bytes], seed: int = 0) -> None:
        self._payloads, self._seed = payloads, seed
        self._world: Whiteboard | None = None
        self._request = 0
        self._said = 0

    @property
    def world(self) -> Whiteboard:
        assert self._world is not None, "`ftm EXPRESSION` comes first"
        return self._world

    def obey(self, line: str) -> list[str]:
        """What follows from one command."""
        command, _, rest = line.partition(" ")
        match command:
            case "ftm":
                self._world = Whiteboard(rest, self._payloads, self._seed)
                self._world.start()
                self._said = len(self._world.said)  # of the launch, nothing
            case "request" | "run":
                self._request += command == "request"
                assert command == "run" or rest.startswith(f"{self._request} "), "the next id"
                self.world.until(self._request, rest.partition("until ")[2])
            case "inject":
                self.world.inject(parse(rest))
                self.world.advance(self.world.loop.ns + ARMED_NS)
            case "adapt":
                self.world.adapt(Goal(expression=rest))
                self.world.until(self._request)
            case "mistake":
                watchdog = self._node(f"{rest[0]}/watchdog")
                watchdog.step(watchdog.bricks[watchdog.name], "sense", NodeDied(rest))
            case "end":
                self.world.end()
                self._judge()
            case _:
                raise AssertionError(f"no such command: {line}")
        said = self.world.said[self._said :]
        self._said = len(self.world.said)
        return said

    def _node(self, name: str) -> SimNode:
        process = self.world.controller.deployment.nodes[name]
        assert isinstance(process, SimProcess) and process.node is not None
        return process.node

    def _judge(self) -> None:
        history = self.world.outcome().history
        judges = {
            "at_most_once": checks.at_most_once(history),
            "exactly_one_answer": checks.exactly_one_answer(history),
            "one_history": checks.one_history(history, reference_run(history, Counting())),
            "one_master": checks.one_master(history),
        }
        for name, found in judges.items():
            self.world.said.append(f"{name}: {'; '.join((found.finding, *found.reasons))}")


def played(text: str) -> Iterator[str]:
    """The lines of a golden file as they should be."""
    commands = [line for line in text.splitlines() if not line.startswith(">")]
    payloads = [line.split()[2].encode() for line in commands if line.startswith("request ")]
    stage = Stage(payloads)
    for line in commands:
        yield line
        if line and not line.startswith("#"):
            yield from (f"> {said}" for said in stage.obey(line))


@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*.txt")), ids=lambda p: p.stem)
def test_dialogue(path: Path, rewrite: bool) -> None:
    text = path.read_text()
    found = "\n".join(played(text)) + "\n"
    if rewrite:
        path.write_text(found)
    assert found == path.read_text()


def test_the_dialogues_are_there() -> None:
    """For each mechanism a normal run, a crash and a hang; the adaptations; what value faults come to."""
    names = {path.stem for path in GOLDEN.glob("*.txt")}
    assert names >= {f"{m}_{what}" for m in MECHANISMS for what in ("normal", "hang")}
    assert all(any(n.startswith(f"{m}_crash") for n in names) for m in MECHANISMS)
    assert names >= {f"{old}_to_{new}" for old, new in WAYS}
    assert names >= {"tr_corrected", "tr_no_majority", "pbr_assert_refused", "lfr_divergence", "none_normal"}
    assert names >= {"pbr_sup_skipped", "pbr_sup_doubled", "pbr_sup_slow", "lfr_sup_doubled"}


def test_no_dialogue_hangs_on_chance() -> None:
    """The seed has a part in nothing that is said."""
    path = GOLDEN / "lfr_tr_crash.txt"
    lines = [line for line in path.read_text().splitlines() if not line.startswith((">", "#"))]
    said = []
    for seed in (0, 1):
        stage = Stage([line.split()[2].encode() for line in lines if line.startswith("request ")], seed)
        said.append([stage.obey(line) for line in lines if line])
    assert said[0] == said[1]
