"""From a campaign file to its experiments: a list that is the same for the same file, seed and code.

The strata take turns, so that a campaign that ends early has seen all of them. The experiment of a stratum
with the number n takes the nth point of the stratum's matrix (then the first again), and draws from a
generator of its own: `Random(f"{seed}/{stratum}/{n}")`. So neither the number of jobs nor the order in
which they end has a part in what is run.

The digest covers the files of the requests and of the scenario, and the code of the functions, too: a
function that was changed makes another campaign.
"""

import hashlib
import itertools
import math
import re
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from random import Random
from typing import Final

import msgspec

from aftbed.adapt.commands import read, scheduled
from aftbed.adapt.suitability import remarks, unsuitable
from aftbed.campaign.experiment import Experiment, faults_of
from aftbed.campaign.spec import (
    APP_PLACE,
    MECHANISM_PLACE,
    SUITABLE,
    AdaptationEntry,
    FaultEntry,
    Spec,
    Value,
    means,
)
from aftbed.core.application import Characteristics
from aftbed.core.errors import ConfigError, FileKeyError, at_key, unknown
from aftbed.ftm.compose import build, expressions, replication_of
from aftbed.ftm.compose import parse as parse_ftm
from aftbed.ftm.registry import packages_of
from aftbed.functions.request_file import names_function, read_requests
from aftbed.functions.source import renamed
from aftbed.inject.memory import refuse_unsafe
from aftbed.inject.model import parse
from aftbed.judge.isolated import declared_by
from aftbed.runtime.unix.code_version import code_version
from aftbed.runtime.unix.trust import NOBODY, OWN_RUN, Trust, vetted
from aftbed.vehicle.aeb.function import default_application
from aftbed.vehicle.scenarios.library import load_scenario, names_file

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
            spec.system.request_file,
            spec.ftti_ms,
        )


def plan(spec: Spec, trust: Trust = NOBODY) -> CampaignPlan:
    """The plan of `spec`, every experiment of it checked. Raises ConfigError naming the key.

    The spec of the plan names each mechanism and each adaptation. Only where `spec` leaves that to what the
    function declares, a function outside of this package is asked, in a process of its own, if `trust` allows
    it; otherwise nothing of it is executed.
    """
    numbers = {entry.name: number for number, entry in enumerate(spec.faults)}  # in the file
    spec = resolved(spec, trust)
    _check_sizes(spec)
    _check_left_out(spec)
    strata = tuple(strata_of(spec))
    if not strata:
        raise FileKeyError("mechanisms", "no entry of faults and adaptations is left for any of them")
    content = msgspec.json.encode(spec, order="deterministic") + _content(spec)
    digest = hashlib.sha256(content).hexdigest()[:ID_DIGITS]
    packages = packages_of(name for ftm in spec.mechanisms for name in parse_ftm(ftm))
    made = CampaignPlan(spec, digest, code_version(packages), strata)
    for stratum in strata:
        with at_key(f"faults[{numbers[stratum.fault.name]}].fault"):
            _check_faults(made, stratum)
        with at_key("adaptations"):
            _check_adaptations(made, stratum)
    return made


def _content(spec: Spec) -> bytes:
    """Of what the spec names: the hashes of code, which is not executed, and the requests of a file.

    Raises ConfigError, also where they cannot be read.
    """
    system, found = spec.system, hashlib.sha256()
    functions = [system.app, system.request_file if names_function(system.request_file) else ""]
    scenario = load_scenario(system.scenario) if names_file(system.scenario) else None
    if not any((system.app, system.request_file, scenario)):
        return b""
    for source in filter(None, functions):
        found.update(b"".join(file.sha256.encode() for file in vetted(source, OWN_RUN).files))
    if system.request_file and not functions[1]:
        found.update(msgspec.msgpack.encode(read_requests(Path(system.request_file)).requests))
    if scenario is not None:
        found.update(msgspec.msgpack.encode(scenario))
    return found.digest()


def strata_of(spec: Spec) -> Iterator[Stratum]:
    """In their order."""
    product = itertools.product(spec.mechanisms, spec.system.placements, spec.adaptations, spec.faults)
    for ftm, placement, adaptation, fault in product:
        if not means(fault.mechanisms, ftm) or not means(adaptation.mechanisms, ftm):
            continue
        if not means(adaptation.faults, fault.name):
            continue
        words = [ftm, *([placement] if len(spec.system.placements) > 1 else [])]
        words += [adaptation.name] if len(spec.adaptations) > 1 else []
        expected = fault.expected(ftm)
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
            raise FileKeyError(
                "faults", f"{entry.name!r}: a matrix of {many} points, allowed are {POINTS_MAX}"
            )


def _check_left_out(spec: Spec) -> None:
    """What is left out would be there."""
    every = [stratum.name for stratum in strata_of(msgspec.structs.replace(spec, leave_out=()))]
    for number, pattern in enumerate(spec.leave_out):
        if every and not any(fnmatchcase(name, pattern) for name in every):
            raise FileKeyError(f"leave_out[{number}]", unknown("stratum", pattern, every))
    if every and not any(strata_of(spec)):
        raise FileKeyError("leave_out", "it leaves no stratum in")


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


def _check_faults(made: CampaignPlan, stratum: Stratum) -> None:
    """Every point of the matrix, before anything runs."""
    where = f"{stratum.fault.name!r} under {stratum.ftm}"
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


def _check_adaptations(made: CampaignPlan, stratum: Stratum) -> None:
    graph = build(stratum.ftm, stratum.placement, application=made.spec.system.app)
    try:
        scheduled(stratum.adaptation.texts, graph, stratum.adaptation.recipe)
    except ConfigError as error:
        raise ConfigError(f"{stratum.adaptation.name!r} under {stratum.ftm}: {error}") from error


# -- what a spec leaves to the function -----------------------------------------------------------
#
# Its plan, and so its ledger, names each mechanism, and each adaptation: reading a ledger asks no function.

NO_ADAPTATION: Final = AdaptationEntry("none")


def resolved(spec: Spec, trust: Trust) -> Spec:
    """`spec` with the mechanisms that suit, and with each adaptation that `{mechanism}` and `{app}` mean.

    The same for what is resolved already. Raises ConfigError, also where the function is not trusted.
    """
    if spec.mechanisms != (SUITABLE,):
        return _with_each_adaptation(spec)
    app = spec.system.app
    return suited(spec, declared_by(app, trust) if app else default_application().characteristics)


def suited(spec: Spec, declared: Characteristics) -> Spec:
    """`spec`, whose mechanisms are `suitable`, for a function that declares this. Raises ConfigError."""
    suit = tuple(ftm for ftm in expressions() if not unsuitable(ftm, declared))
    faults = tuple(_for_known(spec, entry, suit, declared) for entry in spec.faults)
    left = tuple(entry for entry in faults if entry is not None)
    spec = _with_each_adaptation(msgspec.structs.replace(spec, mechanisms=suit, faults=left), declared)
    names = [stratum.name for stratum in strata_of(msgspec.structs.replace(spec, leave_out=()))]
    there = (pattern for pattern in spec.leave_out if any(fnmatchcase(name, pattern) for name in names))
    return msgspec.structs.replace(spec, leave_out=tuple(there))


def _for_known(
    spec: Spec, entry: FaultEntry, suit: tuple[str, ...], declared: Characteristics
) -> FaultEntry | None:
    """`entry` under those mechanisms that know its words; None where none of `suit` does.

    Raises ConfigError where no mechanism at all knows them: then they are wrong.
    """
    meant = [ftm for ftm in expressions() if means(entry.mechanisms, ftm)]
    refused = {ftm: why for ftm in meant if (why := unknown_words(spec, entry, ftm)) is not None}
    if len(refused) == len(meant):
        raise refused[meant[0]]
    known = tuple(ftm for ftm in suit if ftm in meant and ftm not in refused)
    stops = sum(parse(text).action.stops_process for text in _filled(entry, 0, Random(0)))
    if stops > 1:  # without state access no new backup has the state
        known = tuple(ftm for ftm in known if not remarks(ftm, declared))
    if not known:
        return None
    alone = [ftm for ftm in known if remarks(ftm, declared)]
    expect = {ftm: (*entry.expected(ftm), "degraded") for ftm in alone if stops and entry.expected(ftm)}
    return msgspec.structs.replace(entry, mechanisms=known, expect=entry.expect | expect)


def unknown_words(spec: Spec, entry: FaultEntry, ftm: str) -> ConfigError | None:
    """What a mechanism does not know of the entry; None where it knows all of it."""
    made = CampaignPlan(spec, "", "", ())
    try:
        for placement in spec.system.placements:
            _check_faults(made, Stratum("", ftm, placement, entry, NO_ADAPTATION, ()))
    except ConfigError as error:
        return error
    return None


def _with_each_adaptation(spec: Spec, declared: Characteristics | None = None) -> Spec:
    """An entry for each mechanism that `{mechanism}` means, begun by those that can be adapted so.

    `declared`: by the function, where the mechanisms are those that suit it. Without state access nothing
    becomes one that has to start a backup.
    """
    found: list[AdaptationEntry] = []
    for entry in spec.adaptations:
        words = " ".join(entry.texts)
        places = [place for place in (MECHANISM_PLACE, APP_PLACE) if place in words]
        if not places and (declared is None or not entry.texts):
            found.append(entry)
            continue
        app = renamed(spec.system.app) if spec.system.app else ""
        if APP_PLACE in places and not app:
            continue
        for other in spec.mechanisms if MECHANISM_PLACE in places else ("",):
            texts = (text.replace(MECHANISM_PLACE, other).replace(APP_PLACE, app) for text in entry.texts)
            name = entry.name.replace(MECHANISM_PLACE, other)
            made = msgspec.structs.replace(entry, name=name, adapt=tuple(texts))
            lacks_state = declared is not None and bool(other) and bool(remarks(other, declared))
            begun = tuple(
                ftm
                for ftm in spec.mechanisms
                if ftm != other
                and means(entry.mechanisms, ftm)
                and _can_be(spec, made, ftm)
                and not (lacks_state and not replication_of(ftm))
            )
            found += [msgspec.structs.replace(made, mechanisms=begun)] if begun else []
    return msgspec.structs.replace(spec, adaptations=tuple(found) or (NO_ADAPTATION,))


def _can_be(spec: Spec, entry: AdaptationEntry, ftm: str) -> bool:
    """Whether a run that begins with `ftm` can be adapted so. Raises ConfigError where words are wrong."""
    for text in entry.texts:
        read(text)
    try:
        for placement in spec.system.placements:
            scheduled(entry.texts, build(ftm, placement, application=spec.system.app), entry.recipe)
    except ConfigError:
        return False
    return True


def size_of(spec: Spec) -> int:
    """How many experiments there are at most, of the spec of a ledger. Raises ConfigError if too many."""
    _check_sizes(spec)
    return sum(1 for _ in strata_of(spec)) * spec.stop.experiments
