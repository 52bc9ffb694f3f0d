"""What looks for a bug in the package that this interpreter imports, beside the tests.

`python finders.py own|explorers|swarm|campaign [NAME]` prints the first breach that it finds; the exit code
is 1 if there is one, 0 if not. NAME is a bug of tests/sim, which is planted in memory meanwhile.
"""

import itertools
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Final

sys.path.insert(0, str(Path(__file__).parents[1] / "sim"))

from executivemutants import EXECUTIVE
from mutants import MECHANISMS

from aftbed.campaign import ledger
from aftbed.cli import main
from aftbed.judge.simulated import breaches
from aftbed.judge.verdict import Breach
from aftbed.runtime.sim.world import simulate
from aftbed.search import explore, swarm

IN_MEMORY: Final = {mutant.name: mutant for mutant in (*MECHANISMS, *EXECUTIVE)}
# Of each explorer one of so many: by primes, every value of each of their dimensions is met.
EVERY: Final = {"crash": 3, "adapt": 47, "pairs": 97}
CRASH_REQUESTS: Final = 3
SEEDS: Final = 100
CAMPAIGN: Final = ("ci-smoke", "--experiments", "2", "--jobs", "1")
LATE: Final = "degraded"  # which on a busy machine says nothing
TROUBLE: Final = "harness_error"


def own(name: str) -> Iterator[str]:
    """What breaks in the experiments that were chosen for this bug."""
    for setup in IN_MEMORY[name].setups():
        yield from _words(str(setup), breaches(simulate(setup)))


def explorers(name: str) -> Iterator[str]:
    """What the explorers find."""
    for explorer, every in EVERY.items():
        setups = explore.selected(explorer, (), (), CRASH_REQUESTS).setups()
        for setup in itertools.islice(setups, 0, None, every):
            yield from _words(explorer, explore.attempt(setup)[1])


def seeds(name: str) -> Iterator[str]:
    """What a swarm finds."""
    for seed in range(SEEDS):
        yield from _words(f"seed {seed}", swarm.attempt_drawn(swarm.drawn(seed))[1])


def campaign(name: str) -> Iterator[str]:
    """What is not expected in a campaign on real processes."""
    with tempfile.TemporaryDirectory() as place:
        sys.argv = ["aftbed", "campaign", "run", *CAMPAIGN, "--out", f"{place}/out"]
        try:
            main()
        except SystemExit as ended:
            print(f"exit code {ended.code}")  # it is too small for its gates
        results = ledger.read(Path(place, "out", ledger.NAME)).results
    for one in results:
        if one.broken or one.outcome == TROUBLE or (one.unexpected and one.outcome != LATE):
            yield f"{one.experiment.stratum}: {one.outcome}: {'; '.join((*one.broken, *one.reasons))}"


def _words(where: str, found: Iterable[Breach]) -> Iterator[str]:
    return (f"{where}: {breach}" for breach in found)


FINDERS: Final = {"own": own, "explorers": explorers, "swarm": seeds, "campaign": campaign}

if __name__ == "__main__":
    finder, name = sys.argv[1], "".join(sys.argv[2:])
    with IN_MEMORY[name].plant() if name else nullcontext():
        found = next(FINDERS[finder](name), None)
    print(found or "nothing was found")
    sys.exit(found is not None)
