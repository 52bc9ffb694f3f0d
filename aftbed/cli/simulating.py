"""What `aftbed sim` does: simulates one run or many, tells what came of them, and how to repeat a failure.

A verdict is that of a real run. One thing differs: a service that is gone because a fault struck each replica
is no failure here (`unavailable`), since a swarm draws such faults too, and nobody promised anything else.
What was asked for by name and never came about, a fault or an adaptation, is never a pass (G8).
"""

import json
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Final

import msgspec

from aftbed.cli import simagainst
from aftbed.cli.show import show_verdict
from aftbed.cli.simasked import Asked, Make, check_diagram, jobs_of, made_of, seeds_against, seeds_of
from aftbed.cli.simfailure import Failure, again, failure, picture
from aftbed.cli.simview import Bar, adaptation_lines, described, event_lines, spaced
from aftbed.core.valuefault import Flip
from aftbed.judge import checks
from aftbed.judge.verdict import ASSERT, EXIT_CODES, EXIT_INTERRUPTED, REST, Breach, Verdict, Word, outcome
from aftbed.runtime.sim.clock import START_NS
from aftbed.runtime.sim.world import Run, Setup
from aftbed.runtime.unix.worker_pool import each
from aftbed.search.explore import CAR, Found, attempt, missed, tried
from aftbed.vehicle.aeb.function import default_application

SHRUNK_MAX: Final = 3  # of many that broke: shrinking one takes up to 400 runs
MISSED_MAX: Final = 3
LISTED_MAX: Final = 20  # while it goes on


def run(asked: Asked, *, as_json: bool) -> int:
    """Simulate, show, judge; the exit code."""
    if asked.against:
        return simagainst.run(asked.against, seeds_against(asked), as_json=as_json)
    first, last = seeds_of(asked)
    jobs, make = jobs_of(asked.jobs), made_of(asked)
    check_diagram(asked.diagram)
    if asked.seeds is None and asked.minutes is None:
        return _one(asked, make(first), as_json=as_json)
    return _Many(asked, make, first, last, as_json=as_json).run(jobs)


# -- one run --------------------------------------------------------------------------------------


def _one(asked: Asked, setup: Setup, *, as_json: bool) -> int:
    began_s = time.perf_counter()
    done, broken = attempt(setup)
    wall_ms = round((time.perf_counter() - began_s) * 1e3, 3)
    lacking = missed(done) if done is not None and not asked.swarm else ()
    verdict: Word = "fail" if broken else "inconclusive" if lacking else "pass"
    if not as_json:
        print(f"seed {setup.seed}")
        _show(setup, done, verdict, (*map(str, broken), *lacking), wall_ms)
    found = failure(setup, broken, swarm=asked.swarm) if broken else None
    drawing = picture(setup, broken) if found is not None or asked.diagram is not None else None
    if asked.diagram is not None and drawing is not None:
        Path(asked.diagram).write_text(drawing.mermaid)
    if as_json:
        print(json.dumps(_document(setup, done, verdict, found, lacking, wall_ms)))
        return EXIT_CODES[verdict]
    if found is not None and drawing is not None:
        print("\n".join((*drawing.lines(), *found.lines())))
    print(f"seed {setup.seed}")
    return EXIT_CODES[verdict]


def _show(setup: Setup, done: Run | None, verdict: Word, reasons: tuple[str, ...], wall_ms: float) -> None:
    """What happened, and how it is judged: as `aftbed run` shows it."""
    print(described(setup))
    if done is None:
        print("\n".join((*(f"  because    {reason}" for reason in reasons), f"verdict: {verdict}")))
        return
    print("\n".join((*event_lines(done), *adaptation_lines(done))))
    virtual_ms = (done.rest.ended_ns - START_NS) / 1e6
    came = f"; outcome: {outcome(done)}" if setup.faults else ""
    print(f"{virtual_ms:.1f} ms of virtual time in {wall_ms:.1f} ms{came}")
    show_verdict(_verdict(done, verdict, reasons), as_json=False)


def _verdict(done: Run, verdict: Word, reasons: tuple[str, ...]) -> Verdict:
    setup, broken = done.setup, {reason.partition(":")[0] for reason in reasons}
    return Verdict(
        run="",
        seed=setup.seed,
        ftm=setup.ftm,
        placement=setup.placement,
        scenario=setup.scenario or "load",
        verdict=verdict,
        requests=checks.requests(done.history, default_application()),
        vehicle=done.vehicle,
        failovers=checks.failovers(done.history),
        checks={name: "fail" if name in broken else "pass" for name in _checked(done)},
        reasons=list(reasons),
        faults=list(done.faults),
        replay=None,
        seconds=None,
        launch_ms=None,
    )


def _checked(done: Run) -> list[str]:
    """The promises that were checked: of a service that is gone, some cannot be."""
    flips = any(isinstance(fault.action, Flip) for fault in done.setup.faults)
    names = ["G1", "G2", "G4" if flips else "G3", "G6", ASSERT]
    names += [] if done.rest.lost else ["G5", REST]
    return names + ([CAR] if done.vehicle is not None and not done.rest.lost else [])


def _document(
    setup: Setup,
    done: Run | None,
    verdict: Word,
    found: Failure | None,
    lacking: tuple[str, ...],
    wall_ms: float,
) -> dict[str, object]:
    ran: dict[str, object] = {}
    if done is not None:
        judged = _verdict(done, verdict, ())
        ran = {
            "outcome": outcome(done),
            "requests": judged.requests,
            "failovers": judged.failovers,
            "adaptations": done.adaptations,
            "faults": done.faults,
            "vehicle": done.vehicle,
            "virtual_ms": round((done.rest.ended_ns - START_NS) / 1e6, 3),
        }
    broken = found.document() if found is not None else {"breaches": [], "command": None, "shrunk": None}
    words = {"seed": setup.seed, "verdict": verdict, "setup": described(setup), "missed": lacking}
    document = msgspec.to_builtins({**words, **broken, **ran, "wall_ms": wall_ms})
    assert isinstance(document, dict)
    return document


# -- many -----------------------------------------------------------------------------------------


class _Many:
    """The runs of a range of seeds, or of all seeds from one on, for some minutes."""

    def __init__(self, asked: Asked, make: Make, first: int, last: int, *, as_json: bool) -> None:
        self._asked, self._make, self._as_json = asked, make, as_json
        self._first, self._last = first, last
        self._seconds = (asked.minutes or 0.0) * 60
        self._began_s, self._took_s = time.monotonic(), 0.0
        self._runs = self._unavailable = self._requests = self._inconclusive = 0
        self._broken: list[tuple[Setup, tuple[Breach, ...]]] = []
        self._missed: list[str] = []

    def run(self, jobs: int) -> int:
        """Simulate them, and tell; the exit code."""
        if not self._as_json:
            print(f"seeds {self._first}..{'' if self._seconds else self._last}", flush=True)
        interrupted = False
        try:
            self._simulate(jobs)
        except KeyboardInterrupt:
            interrupted = True
        failures = [
            failure(setup, broken, swarm=self._asked.swarm, shrinks=number < SHRUNK_MAX and not interrupted)
            for number, (setup, broken) in enumerate(self._broken)
        ]
        self._draw()
        self._tell(failures)
        word: Word = "fail" if self._broken else "inconclusive" if self._inconclusive else "pass"
        return EXIT_INTERRUPTED if interrupted else EXIT_CODES[word]

    def _simulate(self, jobs: int) -> None:
        total = self._seconds or self._last - self._first + 1
        setups = map(self._make, range(self._first, self._last + 1))
        results = each(tried, setups, jobs, alone=lambda _, setup: again(setup, swarm=self._asked.swarm))
        with Bar("sim", total, quiet=self._as_json) as bar, closing(results) as found:
            for number, setup, what in found:
                self._count(setup, what)
                self._took_s = time.monotonic() - self._began_s
                bar.show(self._took_s if self._seconds else number + 1, self._runs, len(self._broken))
                if self._seconds and self._took_s >= self._seconds:
                    break

    def _count(self, setup: Setup, found: Found) -> None:
        self._runs += 1
        self._requests += found.requests
        self._unavailable += found.lost and not found.breaches
        if found.missed and not self._asked.swarm:
            self._inconclusive += 1
            self._missed += [f"seed {setup.seed}: {missed}" for missed in found.missed[:1]]
        if found.breaches:
            self._broken.append((setup, found.breaches))
            if not self._as_json and len(self._broken) <= LISTED_MAX:
                print(f"seed {setup.seed}: {found.breaches[0]}", flush=True)

    def _draw(self) -> None:
        """The first that broke."""
        if self._asked.diagram is None:
            return
        if self._broken:
            Path(self._asked.diagram).write_text(picture(*self._broken[0]).mermaid)
        else:
            print(f"aftbed: note: nothing broke: {self._asked.diagram} is not written", file=sys.stderr)

    def _tell(self, failures: list[Failure]) -> None:
        took_s = max(self._took_s, 1e-9)
        last = self._first + self._runs - 1
        survived = self._runs - len(self._broken)
        if self._as_json:
            document = {
                "seeds": [self._first, last],
                "runs": self._runs,
                "survived": survived,
                "unavailable": self._unavailable,
                "inconclusive": self._inconclusive,
                "broken": [found.document() for found in failures],
                "runs_per_second": round(self._runs / took_s, 1),
                "requests_per_second": round(self._requests / took_s, 1),
                "seconds": round(took_s, 3),
            }
            print(json.dumps(document))
            return
        for found in failures[:SHRUNK_MAX]:
            print("\n".join((*found.drawn_lines(), *found.lines())))
        if len(failures) > SHRUNK_MAX:
            print(f"{spaced(len(failures))} broke in all; --json lists them, each with its command")
        for reason in self._missed[:MISSED_MAX]:
            print(reason)
        if self._inconclusive:
            print(f"inconclusive: in {spaced(self._inconclusive)} runs, what was asked for never came about")
        print(
            f"{spaced(survived)} of {spaced(self._runs)} survived ({spaced(self._unavailable)} unavailable)"
            f" in {took_s:.1f} s: {spaced(self._runs / took_s)} runs/s,"
            f" {spaced(self._requests / took_s)} requests/s"
        )
        print(f"seeds {self._first}..{last}")
