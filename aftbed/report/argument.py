"""A fragment of a safety argument, in the Goal Structuring Notation, from the campaigns of a bundle.

A goal for each promise; below it a strategy for each mechanism, in the context of what the mechanism
tolerates and needs (FT, A, R); below that a goal for each campaign, with what was measured; its solution is
an entry of the bundle, with its hash. The records are judged again: nothing is taken from the documents
beside them.

A goal is *supported* only if experiments are evidence for it: their faults happened, something is known of
them, all of them kept the promise, and each gate on their strata passes. With one experiment that broke it,
it *failed*. Where there is no evidence, or a gate does not pass, so that too little is known or nothing could
have failed, it is *undeveloped*.

Faults that the mechanism does not claim to tolerate, by what it and the function declare
(`campaign.assumptions`), are no evidence for or against it, and are counted as `outside`; where a campaign
has no others, the mechanism makes no claim there (`unclaimed`). But G6 and G7 hold whatever the faults are.
A campaign without a mechanism (`none`) shows what the faults do; it is left out.

Limits: it says what was measured, of these faults and this function. That these are the faults that matter,
and that the harness tells the truth, is argued elsewhere.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from fnmatch import fnmatch
from typing import Final

import msgspec

from aftbed.adapt.suitability import FAULTS, demand
from aftbed.campaign.assumptions import assumed_wrongly
from aftbed.campaign.experiment import Result
from aftbed.campaign.plan import size_of
from aftbed.campaign.statistics import proportion
from aftbed.campaign.summary import NOT_ACTIVATED, SOMETIMES, GateResult, Summary, confidence_of, summarise
from aftbed.core.application import NONE as NO_ACCESS
from aftbed.core.application import AccessKind, Characteristics
from aftbed.core.errors import ConfigError
from aftbed.ftm.compose import NONE
from aftbed.inject.model import parse
from aftbed.judge.intervals import FTTI
from aftbed.judge.outcome import OUTCOMES, UNKNOWN
from aftbed.report.bundle import NO_CLAIM, Bundle, FiledCampaign

VACUOUS: Final = (NOT_ACTIVATED, "unknown", SOMETIMES)  # gates that fail where nothing could have failed
WORSE_THAN_DOUBLED: Final = OUTCOMES[OUTCOMES.index("duplicate_effect") + 1 :]
HASH_SHOWN: Final = 16  # digits, for people


class GoalStatus(StrEnum):
    SUPPORTED = "supported"
    UNDEVELOPED = "undeveloped"
    FAILED = "failed"


class NodeKind(StrEnum):
    GOAL = "goal"
    STRATEGY = "strategy"
    CONTEXT = "context"
    SOLUTION = "solution"


class LinkKind(StrEnum):
    SUPPORTED_BY = "supported_by"
    IN_CONTEXT_OF = "in_context_of"


class Figures(msgspec.Struct, frozen=True):
    """Of the experiments that are evidence: how many, how many broke the promise, the share at most.

    `outside`: experiments whose faults the mechanism does not claim to tolerate; not among the others.
    """

    experiments: int
    broken: int
    at_most: float
    confidence: float
    outside: int


class GsnNode(msgspec.Struct, frozen=True, omit_defaults=True):
    """`status` and `why` of a goal (`why` it is not supported), `figures` of one with a solution.

    `entry` and `sha256` of a solution.
    """

    id: str
    kind: NodeKind
    text: str
    status: GoalStatus | None = None
    why: str = ""
    figures: Figures | None = None
    entry: str = ""
    sha256: str = ""


class GsnLink(msgspec.Struct, frozen=True):
    """From `source`, which is above."""

    source: str
    target: str
    kind: LinkKind


class Unclaimed(msgspec.Struct, frozen=True):
    """A promise that the mechanism does not claim to keep under the faults of a campaign, and why."""

    promise: str
    ftm: str
    campaign: str
    experiments: int
    why: str

    def __str__(self) -> str:
        return (
            f"{self.promise}: {self.ftm} makes no claim in {self.campaign} ({self.experiments} experiments):"
            f" {self.why}"
        )


class Argument(msgspec.Struct, frozen=True):
    """The document of `aftbed campaign argument --json`."""

    bundle: str
    sha256: str
    note: str
    verifies: tuple[str, ...]
    nodes: tuple[GsnNode, ...]
    links: tuple[GsnLink, ...]
    unclaimed: tuple[Unclaimed, ...]

    def node(self, name: str) -> GsnNode:
        return next(node for node in self.nodes if node.id == name)

    def below(self, name: str, kind: LinkKind = LinkKind.SUPPORTED_BY) -> list[GsnNode]:
        """What supports the node, or is its context."""
        return [self.node(link.target) for link in self.links if (link.source, link.kind) == (name, kind)]

    @property
    def holds(self) -> bool:
        """Whether each campaign supports what it is evidence for."""
        return all(node.status is GoalStatus.SUPPORTED for node in self.nodes if node.figures is not None)

    @property
    def goals(self) -> list[GsnNode]:
        """Those of the promises."""
        below = {link.target for link in self.links}
        return [node for node in self.nodes if node.kind is NodeKind.GOAL and node.id not in below]


# -- promises -------------------------------------------------------------------------------------


class Promise(msgspec.Struct, frozen=True):
    """What is promised, and how a result that is known and struck shows it.

    `is_about`: the results that are evidence for or against it at all. `always`: whatever the faults are.
    """

    id: str
    text: str
    is_broken: Callable[[Result], bool]
    is_about: Callable[[Result], bool] = lambda result: True
    always: bool = False


def _check_broken(name: str) -> Callable[[Result], bool]:
    return lambda result: any(reason.partition(":")[0] == name for reason in result.broken)


def _doubled(result: Result) -> bool:
    return result.outcome == "duplicate_effect" or bool(result.requests and result.requests.duplicated)


def _unanswered(result: Result) -> bool:
    requests = result.requests
    doubled_or_lost = requests is not None and bool(requests.lost or requests.duplicated)
    return result.outcome in ("omission", "unavailable", "hang") or doubled_or_lost


def _wrong(result: Result) -> bool:
    return result.outcome == "sdc" or bool(result.requests and result.requests.wrong)


def _alters_value(result: Result) -> bool:
    return any(parse(text).action.alters_value for text in result.experiment.faults)


def _adaptation_broken(result: Result) -> bool:
    return _check_broken("whole_graph")(result) or _doubled(result) or _unanswered(result) or _wrong(result)


PROMISES: Final = (
    Promise(
        "G1",
        "At most once: a request takes effect at most once, over retries, failover and adaptation",
        _doubled,
        lambda r: _doubled(r) or r.outcome not in WORSE_THAN_DOUBLED,  # a worse outcome may hide it
    ),
    Promise("G2", "Exactly one answer: each request gets one reply", _unanswered),
    Promise("G3", "One history: the replies are those of the function without a mechanism", _wrong),
    Promise("G4", "Value: a value fault does not reach the client", _wrong, _alters_value),
    Promise(
        "G5",
        "Adaptation: these hold while it runs, and it completes or leaves the graph that was there",
        _adaptation_broken,
        lambda r: bool(r.experiment.adaptations),
    ),
    Promise(
        "G6",
        "One master: at any instant the replies of at most one replica are accepted",
        _check_broken("one_master"),
        always=True,
    ),
    Promise(
        "G7",
        "Clean exit: whatever dies, nothing of a run is left",
        _check_broken("clean_exit"),
        lambda r: r.experiment.runtime != "sim",  # of a simulated run nothing could be left
        always=True,
    ),
)
HONEST: Final = Promise(
    "G8",
    "Honest verdict: the faults happened, and of each run something is known",
    lambda r: not r.activated or r.outcome in UNKNOWN,
)


def _ftti(filed: Iterable[FiledCampaign]) -> Iterator[Promise]:
    """Where a campaign has an FTTI: of the experiments whose faults have intervals."""
    texts = dict.fromkeys(one.ledger.head.spec.ftti for one in filed if one.ledger.head.spec.ftti)
    if texts:
        yield Promise(
            "FTTI",
            f"Time: each fault is handled within the fault tolerant time interval, {', '.join(texts)}",
            _check_broken(FTTI),
            lambda r: bool(r.experiment.ftti_ms) and not r.noisy and any(one.of_fault for one in r.intervals),
        )


# -- evidence -------------------------------------------------------------------------------------


class _Evidence(msgspec.Struct, frozen=True):
    """What one campaign shows of one promise under one mechanism."""

    status: GoalStatus
    why: str
    figures: Figures


class _Judged:
    """A campaign, judged again."""

    def __init__(self, filed: FiledCampaign) -> None:
        self.entry, spec = filed.entry, filed.ledger.head.spec
        self.name = filed.entry.partition("/")[0]
        self.spec, self.environment = spec, filed.environment
        self.confidence = confidence_of(spec)
        seconds = sum(result.seconds for result in filed.ledger.results)
        self.summary: Summary = summarise(filed.ledger, size_of(spec), seconds)
        self.results: dict[str, list[Result]] = {}
        for result in filed.ledger.results:
            if result.experiment.ftm != NONE:
                self.results.setdefault(result.experiment.ftm, []).append(result)
        functions = filed.environment.functions
        self._declared: Callable[[str], Characteristics] = lambda source: _declared(functions, source)
        self._outside: dict[str, str] = {}  # by the id of the experiment

    def evidence(self, promise: Promise, ftm: str) -> _Evidence | Unclaimed | None:
        """None where the campaign is not about it."""
        about = [r for r in self.results.get(ftm, ()) if not r.activated or promise.is_about(r)]
        about = about if any(promise.is_about(r) for r in about) else []
        if not about:
            return None
        inside = [r for r in about if promise.always or not self._why_outside(r)]
        if not any(promise.is_about(r) for r in inside):
            whys = (why for r in about if promise.is_about(r) and (why := self._why_outside(r)))
            return Unclaimed(promise.id, ftm, self.name, len(about), next(whys, "its faults did not happen"))
        outside = len(about) - len(inside)
        known = [r for r in inside if r.activated and r.outcome not in UNKNOWN and promise.is_about(r)]
        broken = [r for r in known if promise.is_broken(r)]
        figures = self._figures(len(broken), len(known), outside)
        if broken:
            first = broken[0]
            because = next(iter((*first.broken, *first.reasons)), first.outcome)
            return _Evidence(GoalStatus.FAILED, f"experiment {first.experiment.id}: {because}", figures)
        strata = {r.experiment.stratum for r in inside}
        if failed := self._failed_gates(strata):
            return _Evidence(GoalStatus.UNDEVELOPED, _gate(failed[0]), figures)
        if not known:
            why = "none of the faults happened, or nothing is known of them"
            return _Evidence(GoalStatus.UNDEVELOPED, why, figures)
        return _Evidence(GoalStatus.SUPPORTED, "", figures)

    def honesty(self, ftm: str) -> _Evidence | None:
        """G8: of the gates that are there for it. A run that did not strike is counted as broken."""
        group = self.results.get(ftm, [])
        if not group:
            return None
        figures = self._figures(sum(map(HONEST.is_broken, group)), len(group), 0)
        strata = {r.experiment.stratum for r in group}
        failed = [gate for gate in self._failed_gates(strata) if gate.metric in VACUOUS]
        if failed:
            return _Evidence(GoalStatus.FAILED, _gate(failed[0]), figures)
        return _Evidence(GoalStatus.SUPPORTED, "", figures)

    def _failed_gates(self, strata: Iterable[str]) -> list[GateResult]:
        """Those that judge one of these strata."""
        names = list(strata)
        return [
            gate
            for gate in self.summary.gates
            if gate.word == "fail"
            and any(name == gate.strata or fnmatch(name, gate.strata) for name in names)
        ]

    def _figures(self, broken: int, of: int, outside: int) -> Figures:
        at_most = proportion(broken, of, self.confidence).high
        return Figures(of, broken, at_most, self.confidence, outside)

    def _why_outside(self, result: Result) -> str:
        """Why the mechanism does not claim to hold in this experiment; "" if it does."""
        name = result.experiment.id
        if name not in self._outside:
            self._outside[name] = _unclassed(result) or self._assumed_wrongly(result)
        return self._outside[name]

    def _assumed_wrongly(self, result: Result) -> str:
        try:
            return assumed_wrongly(result, self._declared)
        except ConfigError as error:
            return str(error)


def _gate(gate: GateResult) -> str:
    return f"gate {gate.metric} {gate.limit} in {gate.strata}: {gate.reason}"


def _unclassed(result: Result) -> str:
    """A fault that is of no class of the fault model; "" if each is of one."""
    for text in result.experiment.faults:
        action = parse(text).action
        if not (action.stops_process or action.alters_value):
            return f"{action.name} is of no class of faults that a mechanism declares ({', '.join(FAULTS)})"
    return ""


def _declared(functions: Mapping[str, Characteristics | None], source: str) -> Characteristics:
    found = functions.get(source)
    if found is None:
        raise ConfigError(f"what {source} declares is not known")
    return found


# -- the argument ---------------------------------------------------------------------------------


def argument_of(name: str, bundle: Bundle, filed: Sequence[FiledCampaign]) -> Argument:
    """From a bundle whose files fit. `name`: of its file."""
    campaigns = [_Judged(one) for one in filed]
    ftms = list(dict.fromkeys(ftm for campaign in campaigns for ftm in campaign.results))
    nodes: list[GsnNode] = []
    links: list[GsnLink] = []
    unclaimed: list[Unclaimed] = []
    for promise in (*PROMISES, HONEST, *_ftti(filed)):
        found: dict[tuple[str, str], _Evidence] = {}
        for ftm in ftms:
            for campaign in campaigns:
                match campaign.honesty(ftm) if promise is HONEST else campaign.evidence(promise, ftm):
                    case _Evidence() as evidence:
                        found[ftm, campaign.name] = evidence
                    case Unclaimed() as outside:
                        unclaimed.append(outside)
        _develop(promise, found, nodes, links)
    nodes += [_context(ftm, campaigns) for ftm in ftms]
    nodes += [_solution(campaign, bundle) for campaign in campaigns]
    verifies = dict.fromkeys(name for campaign in campaigns for name in campaign.spec.verifies)
    shown = (tuple(nodes), tuple(links), tuple(unclaimed))
    return Argument(name, bundle.sha256, NO_CLAIM, tuple(verifies), *shown)


def _develop(
    promise: Promise,
    found: Mapping[tuple[str, str], _Evidence],
    nodes: list[GsnNode],
    links: list[GsnLink],
) -> None:
    """The goal of a promise, and all below it."""
    status, why = _together(found.values())
    why = why if found else "no campaign is about it"
    nodes.append(GsnNode(promise.id, NodeKind.GOAL, promise.text, status, why))
    for ftm in dict.fromkeys(ftm for ftm, _ in found):
        strategy = f"S.{promise.id}.{ftm}"
        nodes.append(GsnNode(strategy, NodeKind.STRATEGY, f"Over the campaigns under {ftm}"))
        links.append(GsnLink(promise.id, strategy, LinkKind.SUPPORTED_BY))
        links.append(GsnLink(strategy, f"C.{ftm}", LinkKind.IN_CONTEXT_OF))
        for (of, campaign), evidence in found.items():
            if of == ftm:
                goal = f"{promise.id}.{ftm}.{campaign}"
                words = _in_words(evidence.figures, campaign, honest=promise is HONEST)
                shown = (words, evidence.status, evidence.why, evidence.figures)
                nodes.append(GsnNode(goal, NodeKind.GOAL, *shown))
                links.append(GsnLink(strategy, goal, LinkKind.SUPPORTED_BY))
                links.append(GsnLink(goal, f"Sn.{campaign}", LinkKind.SUPPORTED_BY))


def _together(found: Iterable[_Evidence]) -> tuple[GoalStatus, str]:
    """The worst of them: what is supported in part is not supported."""
    order = (GoalStatus.FAILED, GoalStatus.UNDEVELOPED, GoalStatus.SUPPORTED)
    worst = min(found, key=lambda one: order.index(one.status), default=None)
    return (worst.status, worst.why) if worst is not None else (GoalStatus.UNDEVELOPED, "")


def _in_words(figures: Figures, campaign: str, *, honest: bool) -> str:
    what = "did not strike, or are not known" if honest else "broke it"
    words = f"{campaign}: {figures.broken} of {figures.experiments} experiments {what}"
    if figures.experiments:
        words += f", at most {100 * figures.at_most:.3g} % with {100 * figures.confidence:.3g} % confidence"
    return words + (f"; {figures.outside} outside of its fault model" if figures.outside else "")


def _context(ftm: str, campaigns: Iterable[_Judged]) -> GsnNode:
    """FT, A and R of a mechanism, as it declares them; A beside what the functions declare."""
    wanted = demand(ftm)
    tolerates = ", ".join(FAULTS[fault] for fault in wanted.tolerates) or "no faults"
    needs = [
        word
        for word, why in (
            ("a deterministic function", wanted.deterministic),
            ("state access", wanted.state_access),
            ("exact state access", wanted.exact_state),
        )
        if why
    ]
    functions = dict.fromkeys(
        f"{source or 'the built-in function'}: {_characteristics(declared)}"
        for campaign in campaigns
        if ftm in campaign.results
        for source, declared in campaign.environment.functions.items()
    )
    lines = [
        f"{ftm}",
        f"FT: {tolerates}",
        f"A: needs {' and '.join(needs) or 'nothing of the function'}; {'; '.join(functions)}",
        f"R: {wanted.cpus} CPU{'s' if wanted.cpus > 1 else ''}, CPU load {wanted.cpu_load},"
        f" bandwidth {wanted.bandwidth}",
    ]
    return GsnNode(f"C.{ftm}", NodeKind.CONTEXT, "\n".join(lines))


def _characteristics(declared: Characteristics | None) -> str:
    if declared is None:
        return "not known"
    access = declared.state_access
    words = ["deterministic" if declared.deterministic else "not deterministic"]
    if access == NO_ACCESS:
        words.append("no state access")
    else:
        words.append("exact state" if access.kind is AccessKind.EXACT else "approximate state")
    return ", ".join(words)


def _solution(campaign: _Judged, bundle: Bundle) -> GsnNode:
    """The ledger of a campaign, as it lies in the bundle."""
    runtime = "simulated" if campaign.spec.system.runtime == "sim" else "on real processes"
    text = (
        f"Campaign {campaign.name}, {runtime}: {campaign.summary.experiments} of {campaign.summary.planned}"
        f" experiments, seed {campaign.spec.seed}, code {campaign.environment.code}, gate"
        f" {campaign.summary.gate}"
    )
    return GsnNode(
        f"Sn.{campaign.name}",
        NodeKind.SOLUTION,
        text,
        entry=campaign.entry,
        sha256=bundle.files[campaign.entry],
    )


def argument_lines(found: Argument) -> Iterator[str]:
    """For people, as a tree."""
    yield f"{found.bundle}, sha256 {found.sha256}"
    if found.verifies:
        yield f"verifies {', '.join(found.verifies)}"
    for goal in found.goals:
        yield f"{goal.id} {goal.status}: {goal.text}"
        if not found.below(goal.id):
            yield f"  {goal.why}"
        for strategy in found.below(goal.id):
            for sub in found.below(strategy.id):
                yield f"  {strategy.id.rpartition('.')[2]} {sub.status}: {sub.text}"
                if sub.why:
                    yield f"    {sub.why}"
    for node in found.nodes:
        if node.kind is NodeKind.CONTEXT:
            yield from (
                f"{'  ' if number else ''}{line}" for number, line in enumerate(node.text.split("\n"))
            )
        if node.kind is NodeKind.SOLUTION:
            yield f"{node.text}: {node.entry} {node.sha256[:HASH_SHOWN]}..."
    yield from map(str, found.unclaimed)
    yield found.note
