"""From a campaign file to its experiments: a list that is the same for the same file, seed and code.

The strata take turns, so that a campaign that ends early has seen all of them. The experiment of a stratum
with the number n takes the nth point of the stratum's matrix (then the first again), and draws from a
generator of its own: `Random(f"{seed}/{stratum}/{n}")`. So neither the number of jobs nor the order in
which they end has a part in what is run.
"""

import hashlib
import itertools
import math
import re
from collections.abc import Iterator
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from random import Random
from typing import Final

import msgspec

import aftbed
from aftbed.adapt.commands import scheduled
from aftbed.campaign.experiment import Experiment, faults_of
from aftbed.campaign.spec import ANY, AdaptationEntry, FaultEntry, Spec, Value
from aftbed.core.errors import ConfigError, unknown
from aftbed.ftm.compose import build
from aftbed.inject.memory import refuse_unsafe

ID_DIGITS: Final = 16
SEED_BITS: Final = 31
JOINED: Final = " · "
STRATA_MAX: Final = 10_000  # with those that are left out
POINTS_MAX: Final = 100_000  # of one matrix: each of them is checked before anything runs
_PLACE: Final = re.compile(r"\{([^{}]*)\}")


class Stratum(msgspec.Struct, frozen=True):
    """`expected`: outcomes, none where all are accepted."""

    name: str
    ftm: str
    placement: str
    fault: FaultEntry
    adaptation: AdaptationEntry
    expected: tuple[str, ...]


class CampaignPlan(msgspec.Struct, frozen=True):
    """`digest` of the spec: what belongs to another one is not mixed with this."""

    spec: Spec
    digest: str
    code: str
    strata: tuple[Stratum, ...]

    @property
    def size(self) -> int:
        """How many experiments there are at most."""
        return len(self.strata) * self.spec.stop.experiments

    def experiments(self) -> Iterator[Experiment]:
        """All of them, in order. Raises ConfigError where one cannot be."""
        for number in range(self.spec.stop.experiments):
            for place, stratum in enumerate(self.strata):
                yield self.experiment(number * len(self.strata) + place, number, stratum)

    def experiment(self, index: int, number: int, stratum: Stratum) -> Experiment:
        """The one of `stratum` with that number."""
        spec = self.spec
        chance = Random(f"{spec.seed}/{stratum.name}/{number}")
        seed = chance.getrandbits(SEED_BITS)
        faults = _filled(stratum.fault, number, chance)
        whole = f"{self.digest}/{self.code}/{index}"
        return Experiment(
            hashlib.sha256(whole.encode()).hexdigest()[:ID_DIGITS],
            index,
            number,
            stratum.name,
            seed,
            stratum.ftm,
            stratum.placement,
            spec.system.runtime,
            spec.system.scenario,
            spec.system.requests,
            spec.system.rate_hz,
            faults,
            stratum.adaptation.texts,
            stratum.adaptation.recipe if stratum.adaptation.texts else "",
            stratum.expected,
            spec.recovery_budget_ms,
            spec.system.app,
        )


def plan(spec: Spec) -> CampaignPlan:
    """The plan of `spec`, every experiment of it checked. Raises ConfigError naming the key."""
    _check_sizes(spec)
    _check_left_out(spec)
    strata = tuple(strata_of(spec))
    if not strata:
        raise ConfigError("mechanisms: no entry of faults and adaptations is left for any of them")
    digest = hashlib.sha256(msgspec.json.encode(spec, order="deterministic")).hexdigest()[:ID_DIGITS]
    made = CampaignPlan(spec, digest, code_version(), strata)
    for stratum in strata:
        _check(made, stratum)
    return made


@lru_cache(maxsize=1)
def code_version() -> str:
    """The version of the package, and a digest of its code: a changed line makes it another one."""
    home, digest = Path(aftbed.__file__).parent, hashlib.sha256()
    for path in sorted(home.rglob("*.py")):
        digest.update(path.relative_to(home).as_posix().encode() + path.read_bytes())
    return f"{aftbed.__version__}+{digest.hexdigest()[:8]}"


def strata_of(spec: Spec) -> Iterator[Stratum]:
    """In their order."""
    product = itertools.product(spec.mechanisms, spec.system.placements, spec.adaptations, spec.faults)
    for ftm, placement, adaptation, fault in product:
        if ftm not in (fault.mechanisms or spec.mechanisms):
            continue
        if ftm not in (adaptation.mechanisms or spec.mechanisms):
            continue
        words = [ftm, *([placement] if len(spec.system.placements) > 1 else [])]
        words += [adaptation.name] if len(spec.adaptations) > 1 else []
        expected = fault.expect.get(ftm, fault.expect.get(ANY, ()))
        name = JOINED.join((*words, fault.name))
        if not any(fnmatchcase(name, pattern) for pattern in spec.leave_out):
            yield Stratum(name, ftm, placement, fault, adaptation, expected)


def _check_sizes(spec: Spec) -> None:
    """A small file can ask for more than any machine has."""
    parts = (spec.mechanisms, spec.system.placements, spec.adaptations, spec.faults)
    if (strata := math.prod(map(len, parts))) > STRATA_MAX:
        raise ConfigError(f"{strata} strata, allowed are {STRATA_MAX}")
    for entry in spec.faults:
        if (many := points(entry)) > POINTS_MAX:
            raise ConfigError(f"faults: {entry.name!r}: a matrix of {many} points, allowed are {POINTS_MAX}")


def _check_left_out(spec: Spec) -> None:
    """What is left out would be there."""
    every = [stratum.name for stratum in strata_of(msgspec.structs.replace(spec, leave_out=()))]
    for number, pattern in enumerate(spec.leave_out):
        if every and not any(fnmatchcase(name, pattern) for name in every):
            raise ConfigError(f"leave_out[{number}]: {unknown('stratum', pattern, every)}")
    if every and not any(strata_of(spec)):
        raise ConfigError("leave_out: it leaves no stratum in")


def _filled(entry: FaultEntry, number: int, chance: Random) -> tuple[str, ...]:
    """The faults of experiment `number`: its point of the matrix, and what is drawn."""
    values: dict[str, Value] = {}
    for name, allowed in reversed(entry.matrix.items()):  # the last one changes first
        number, at = divmod(number, len(allowed))
        values[name] = allowed[at]
    values |= {name: chance.randint(*limits) for name, limits in entry.draw.items()}

    def value(place: re.Match[str]) -> str:
        if place[1] not in values:
            raise ConfigError(f"fault {entry.texts}: {{{place[1]!r}}} stands neither in matrix nor in draw")
        return str(values[place[1]])

    return tuple(_PLACE.sub(value, text) for text in entry.texts)


def points(entry: FaultEntry) -> int:
    """How many points its matrix has."""
    return math.prod(map(len, entry.matrix.values()))


def population(entry: FaultEntry) -> int:
    """How many faults the entry can mean: the size of its part of the fault space."""
    return points(entry) * math.prod(high - low + 1 for low, high in entry.draw.values())


def _check(made: CampaignPlan, stratum: Stratum) -> None:
    """Every point of the matrix, before anything runs."""
    where = f"faults: {stratum.fault.name!r} under {stratum.ftm}"
    system = made.spec.system
    graph = build(stratum.ftm, stratum.placement, application=system.app)
    try:
        for number in range(points(stratum.fault)):
            for fault in faults_of(made.experiment(0, number, stratum), graph):
                if not fault.action.unsafe:
                    continue
                if system.runtime == "sim":
                    raise ConfigError(
                        f"{fault}: under system.runtime sim processes have no memory of their own"
                    )
                refuse_unsafe(str(fault), agreed=system.unsafe_memory, option="system.unsafe_memory: true")
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    try:
        scheduled(stratum.adaptation.texts, graph, stratum.adaptation.recipe)
    except ConfigError as error:
        raise ConfigError(f"adaptations: {stratum.adaptation.name!r} under {stratum.ftm}: {error}") from error
