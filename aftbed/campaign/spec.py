"""A campaign file: what is tried, how often, what is expected of it, and what fails the build.

    campaign: crash
    about: A crash of the primary at each point of a request's way.
    seed: 1
    system: {requests: 100}                  # or {scenario: ccrs-50}
    mechanisms: [pbr, lfr]
    faults:
    - name: crash primary
      fault: crash primary at {event} nth {nth}
      matrix: {event: [request.received, server.exit, reply.sent]}    # each of them, in turn
      draw: {nth: [1, 90]}                                            # one of them, by the seed
      expect: {"*": [masked, tolerated]}
    stop: {experiments: 30}                  # in each stratum
    gates:
    - {metric: unexpected, max: 0.02}        # the upper end of the interval must not exceed it

A *stratum* is one mechanism, one placement, one adaptation and one entry of `faults`. The experiments of a
stratum go through its matrix in turn; what is drawn depends on the seed, the stratum and the number of the
experiment, and on nothing else. Words that a mechanism does not know (an event that it never emits) are
refused before anything runs: such an entry has `mechanisms: [...]` of its own.

`mechanisms: [suitable]` are those that suit what the function declares; an entry of `faults` is then left out
where a mechanism does not know its words. `{mechanism}` in an entry of `adaptations` is each other mechanism,
`{app}` the function. What that comes to is in the plan, and in the ledger: see `plan.resolved`.

*Expected* is the class of the outcome (`experiment.OUTCOMES`), per mechanism, or per pattern of them; `"*"`
is any other. An outcome that is better than the expected ones counts as unexpected too: an oracle that never
sees anything is no oracle.
"""

from collections.abc import Callable, Iterable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from aftbed.campaign.experiment import RATE_HZ_MAX, REQUESTS_MAX
from aftbed.campaign.states import OF_A_CAR, RunState
from aftbed.core.errors import ConfigError, FileKeyError, at_key, unknown
from aftbed.core.graph import PLACEMENTS
from aftbed.core.requirements import check_requirements
from aftbed.core.script import RECIPES
from aftbed.ftm.compose import expressions, is_listed
from aftbed.functions.request_file import located_requests
from aftbed.functions.source import located
from aftbed.judge.outcome import OUTCOMES
from aftbed.runtime.unix.options import CarRun, LoadRun, ftti_ms_of
from aftbed.vehicle.scenarios.library import load_scenario, located_scenario

SHIPPED: Final = Path(__file__).resolve().parent.parent / "campaigns"
ANY: Final = "*"
SUITABLE: Final = "suitable"
MECHANISM_PLACE: Final = "{mechanism}"  # in an adaptation: each other one
APP_PLACE: Final = "{app}"
EXPERIMENTS_MAX: Final = 1_000_000
FHTI_MARGIN: Final = "fhti_margin"  # 1 - FHTI / FTTI
METRICS: Final = (
    *OUTCOMES,
    "failed",
    "unexpected",
    "unknown",  # inconclusive, or a harness_error
    "not_activated",
    "broken",
    "collision",
    "recovery_ms_p50",
    "recovery_ms_p99",
    "blackout_ms_p50",
    "blackout_ms_p99",
    "adapt_blackout_ms_p50",
    "adapt_blackout_ms_p99",
    "fdti_ms_p50",
    "fdti_ms_p99",
    "frti_ms_p50",
    "frti_ms_p99",
    "fhti_ms_p50",
    "fhti_ms_p99",
    "coverage",  # diagnostic: detected or tolerated, of the faults that were activated
    FHTI_MARGIN,
)

Value = str | int | float
Positive = Annotated[int, Meta(ge=1, le=EXPERIMENTS_MAX)]
Share = Annotated[float, Meta(gt=0, lt=1)]


class System(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the mechanisms protect: `app` ("": the brake), asked for `requests` of a load, or by a car.

    `request_file`: what is sent, as `--requests` has it; behind the last of a file comes the first. Relative
    paths are looked up beside the campaign file, and then in the current directory.
    """

    app: str = ""  # the protected function, as --app has it; none: the brake
    request_file: str = ""
    requests: Annotated[int, Meta(ge=1, le=REQUESTS_MAX)] = 100  # of each experiment without a car
    rate_hz: Annotated[float, Meta(ge=0, le=RATE_HZ_MAX)] = 0.0  # 0: the next follows the reply
    scenario: str = ""  # a car asks, instead of requests
    placements: tuple[str, ...] = ("process",)  # process, replica, single
    runtime: Literal["unix", "sim"] = "unix"  # real processes, or the simulator
    unsafe_memory: bool = False  # faults may strike any memory of a node


class FaultEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`fault` in the words of `--inject`, `{name}`s filled in; several strike in the same run."""

    name: str  # of its strata
    fault: str | tuple[str, ...] = ()  # the words of --inject with {name}s in them; several strike in one run
    matrix: dict[str, tuple[Value, ...]] = {}  # values of a {name}: each of them, in turn
    draw: dict[str, tuple[int, int]] = {}  # least and most of a {name}: one of them, by the seed
    mechanisms: tuple[str, ...] = ()  # where not all; patterns as of file names
    expect: dict[str, tuple[str, ...]] = {}  # outcomes by mechanism, or by patterns of them; "*" is any other
    may_miss: bool = False  # there may be nothing to strike: a stratum where nothing struck is no failure

    @property
    def texts(self) -> tuple[str, ...]:
        """As they stand in the file."""
        return (self.fault,) if isinstance(self.fault, str) else self.fault

    def expected(self, mechanism: str) -> tuple[str, ...]:
        """By its name, else by the first pattern that means it, `"*"` last."""
        patterns = (mechanism, *(name for name in self.expect if name != ANY), ANY)
        found = (name for name in patterns if name in self.expect and fnmatchcase(mechanism, name))
        return self.expect.get(next(found, ""), ())


class AdaptationEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`adapt` in the words of `--adapt`; in each run, one after the other."""

    name: str  # of its strata
    adapt: str | tuple[str, ...] = ()  # words of --adapt; {mechanism}: each other one, {app}: the function
    recipe: str = RECIPES[0]  # drained or paper
    mechanisms: tuple[str, ...] = ()  # where not all; patterns as of file names
    faults: tuple[str, ...] = ()  # entries of `faults`, where not all; patterns, too

    @property
    def texts(self) -> tuple[str, ...]:
        """As they stand in the file."""
        return (self.adapt,) if isinstance(self.adapt, str) else self.adapt


class StopRule(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When enough is known: whichever comes first.

    `half_width`: of the interval of `unexpected` in a stratum, looked at after each of `looks` equal parts
    of `experiments`, with a confidence that allows for so many looks.
    """

    experiments: Positive = 20  # per stratum
    half_width: Share | None = None
    looks: Annotated[int, Meta(ge=1, le=20)] = 4  # each after an equal part of experiments
    minutes: Annotated[float, Meta(gt=0, le=100_000)] | None = None  # of the campaign
    first_failure: bool = False  # one failure ends it


class Gate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`metric` of the strata whose name matches `strata`, taken together, is at most `max`, or at least
    `min`.

    A share is judged by the bound of its interval, so few experiments prove little. But `max: 0` is judged
    by what was measured: not one may be seen.
    """

    metric: str  # an outcome, unexpected, fhti_ms_p99, ...
    max: float | None = None  # what it may be at most
    min: float | None = None  # what it must be at least
    strata: str = ANY  # a pattern as of file names


class Spec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A campaign file, key by key."""

    campaign: Annotated[str, Meta(pattern="^[a-z0-9][a-z0-9-]{0,40}$")]  # its name
    mechanisms: Annotated[tuple[str, ...], Meta(min_length=1)]  # FTM expressions; or [suitable]
    faults: Annotated[tuple[FaultEntry, ...], Meta(min_length=1)]  # what strikes, and what is expected
    about: str = ""  # for people
    seed: Annotated[int, Meta(ge=0)] = 0  # the same seed draws the same experiments
    system: System = System()  # what the mechanisms protect
    adaptations: tuple[AdaptationEntry, ...] = (AdaptationEntry("none"),)  # in each experiment
    leave_out: tuple[str, ...] = ()  # strata, by patterns as of file names
    stop: StopRule = StopRule()  # when enough is known
    gates: tuple[Gate, ...] = ()  # what fails the campaign
    confidence: Annotated[float, Meta(gt=0.5, lt=1)] = 0.95  # of all intervals
    recovery_budget_ms: Annotated[float, Meta(gt=0)] | None = None  # longer is `degraded`
    sometimes: tuple[str, ...] = ()  # each a `RunState` that at least one experiment must have been in
    verifies: tuple[str, ...] = ()  # requirements; as it is read, those of the scenario too
    ftti: str = ""  # as 100ms, of bus time: a fault that is handled later breaks a promise
    bounded: bool = False  # an FHTI above its bound fails the campaign on real processes, too
    not_activated_max: Annotated[float, Meta(ge=0, le=1)] = 0.3  # two gates that are always there (G8)
    unknown_max: Annotated[float, Meta(ge=0, le=1)] = 0.3  # share of those of which nothing is known

    @property
    def ftti_ms(self) -> float:
        """0: none. Raises ConfigError, also if it is shorter than a cycle."""
        system = self.system
        work = CarRun(system.scenario, None, "") if system.scenario else LoadRun(1, system.rate_hz)
        return ftti_ms_of("ftti", self.ftti, work) if self.ftti else 0.0


def spec_path(name: str) -> Path:
    """Of the shipped campaign of that name, or of a file. Raises ConfigError."""
    if name.endswith((".yaml", ".yml")):
        return Path(name)
    if Path(name).exists():
        raise ConfigError(f"{name}: a file that ends in .yaml, or the name of a shipped campaign is allowed")
    if name not in shipped():
        raise unknown("campaign", name, shipped())
    return SHIPPED / f"{name}.yaml"


def read_spec(name: str) -> Spec:
    """The shipped campaign of that name, or a file. Raises ConfigError naming file, line and key."""
    path = spec_path(name)
    from aftbed.core.yaml_file import in_file, read_yaml  # noqa: PLC0415 - a worker reads no YAML

    spec = read_yaml(path, Spec)
    with in_file(path):
        spec = msgspec.structs.replace(spec, system=_located(spec.system, path.parent))
        check(spec)
        if spec.system.scenario:  # here, since records are reported where the scenario's file is not
            verifies = dict.fromkeys((*spec.verifies, *load_scenario(spec.system.scenario).verifies))
            spec = msgspec.structs.replace(spec, verifies=tuple(verifies))
    return spec


_Locator = Callable[[str, Path], str]


def _located(system: System, folder: Path) -> System:
    """With absolute paths, of files in `folder` or else in the current directory. Raises ConfigError."""
    locators: dict[str, _Locator] = {
        "app": located,
        "request_file": located_requests,
        "scenario": located_scenario,
    }
    found = {}
    for key, locate in locators.items():
        if text := getattr(system, key):
            with at_key(f"system.{key}"):
                found[key] = _beside_or_here(text, folder, locate)
    return msgspec.structs.replace(system, **found)


def _beside_or_here(text: str, folder: Path, locate: _Locator) -> str:
    here = Path.cwd()
    try:
        return locate(text, folder)
    except ConfigError as error:
        if folder.resolve() == here:
            raise
        try:
            return locate(text, here)
        except ConfigError:
            raise ConfigError(f"{error}, beside the campaign file or in {here}") from error


def shipped() -> list[str]:
    """The names of the campaigns that come with the package."""
    return sorted(path.stem for path in SHIPPED.glob("*.yaml"))


def check(spec: Spec) -> None:
    """Check what the types do not express. Raises ConfigError naming the key."""
    if spec.mechanisms != (SUITABLE,):
        for number, name in enumerate(spec.mechanisms):
            if name != SUITABLE and not is_listed(name):
                raise FileKeyError(f"mechanisms[{number}]", unknown("name", name, (*expressions(), SUITABLE)))
        if SUITABLE in spec.mechanisms:
            raise FileKeyError(
                "mechanisms", f"{SUITABLE!r} stands alone: they are all that suit the function"
            )
    _each_known("sometimes", spec.sometimes, tuple(state.value for state in RunState))
    if not spec.system.scenario and (of_a_car := [name for name in OF_A_CAR if name in spec.sometimes]):
        raise FileKeyError("sometimes", f"{of_a_car[0]}: no experiment has a car: add system.scenario")
    check_requirements("verifies", spec.verifies)
    _each_known("system.placements", spec.system.placements, PLACEMENTS)
    if not spec.system.placements:
        raise FileKeyError("system.placements", "found none, allowed is at least one of them")
    if spec.system.scenario:
        with at_key("system.scenario"):
            load_scenario(spec.system.scenario)
        if spec.system.request_file:
            raise FileKeyError("system.request_file", "the car of system.scenario makes the requests")
    _all_different("faults", [entry.name for entry in spec.faults])
    _all_different("adaptations", [entry.name for entry in spec.adaptations])
    if not spec.adaptations:
        raise FileKeyError("adaptations", "found none; leave the key out, or name at least one")
    for number, entry in enumerate(spec.faults):
        _check_fault(f"faults[{number}]", entry, spec)
    for number, adaptation in enumerate(spec.adaptations):
        where = f"adaptations[{number}]"
        _each_means(f"{where}.mechanisms", adaptation.mechanisms, mechanisms_of(spec))
        _each_means(f"{where}.faults", adaptation.faults, [entry.name for entry in spec.faults])
        if (
            any(MECHANISM_PLACE in text for text in adaptation.texts)
            and MECHANISM_PLACE not in adaptation.name
        ):
            raise FileKeyError(
                f"{where}.name", f"{MECHANISM_PLACE} stands in adapt, so it has to in the name"
            )
        _each_known(f"{where}.recipe", (adaptation.recipe,), RECIPES)
    with at_key("ftti"):
        ftti_ms = spec.ftti_ms
    for number, gate in enumerate(spec.gates):
        _check_gate(f"gates[{number}]", gate)
        if gate.metric == FHTI_MARGIN and not ftti_ms:
            raise FileKeyError(f"gates[{number}].metric", f"{FHTI_MARGIN} is of an FTTI: add ftti, as 100ms")


def mechanisms_of(spec: Spec) -> tuple[str, ...]:
    """Those that may be named in entries."""
    return expressions() if spec.mechanisms == (SUITABLE,) else spec.mechanisms


def means(patterns: tuple[str, ...], name: str) -> bool:
    """Whether one of them means `name`; none of them mean all."""
    return not patterns or name in patterns or any(fnmatchcase(name, pattern) for pattern in patterns)


def _check_fault(where: str, entry: FaultEntry, spec: Spec) -> None:
    _each_means(f"{where}.mechanisms", entry.mechanisms, mechanisms_of(spec))
    for key, values in entry.matrix.items():
        if not values:
            raise FileKeyError(f"{where}.matrix.{key}", "it is empty: name at least one value")
    for key, (low, high) in entry.draw.items():
        if low > high:
            raise FileKeyError(f"{where}.draw.{key}", f"found [{low}, {high}], allowed is [lowest, highest]")
    twice = entry.matrix.keys() & entry.draw.keys()
    if twice:
        raise FileKeyError(where, f"{min(twice)!r} stands in matrix and in draw")
    for mechanism, outcomes in entry.expect.items():
        if mechanism != ANY:
            known = mechanisms_of(spec)
            if not any(means((mechanism,), name) for name in known):
                raise FileKeyError(f"{where}.expect.{mechanism}", unknown("name", mechanism, known))
        _each_known(f"{where}.expect.{mechanism}", outcomes, OUTCOMES)


def _check_gate(where: str, gate: Gate) -> None:
    if gate.metric not in METRICS:
        raise FileKeyError(f"{where}.metric", unknown("metric", gate.metric, METRICS))
    if (gate.max is None) == (gate.min is None):
        raise FileKeyError(where, "either max or min is allowed, and needed")


def _each_known(where: str, names: tuple[str, ...], allowed: tuple[str, ...]) -> None:
    for number, name in enumerate(names):
        if name not in allowed:
            raise FileKeyError(f"{where}[{number}]", unknown("name", name, allowed))


def _each_means(where: str, patterns: tuple[str, ...], allowed: Iterable[str]) -> None:
    for number, pattern in enumerate(patterns):
        if not any(means((pattern,), name) for name in allowed):
            raise FileKeyError(f"{where}[{number}]", unknown("name", pattern, allowed))


def _all_different(where: str, names: list[str]) -> None:
    for number, name in enumerate(names):
        if name in names[:number]:
            raise FileKeyError(f"{where}[{number}].name", f"{name!r} stands twice")
