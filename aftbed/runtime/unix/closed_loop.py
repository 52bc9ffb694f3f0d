"""The closed loop: the command of a run observes it, and has it adapted as a policy says (paper, II).

The `Observer` of `adapt.policy` decides and is pure; here is all I/O around it. The loop lives in the
command, not in the supervisor: it reads files and requests adaptations as any second terminal does, so a run
is the same with it and without it until the first adaptation.

    journals, events, resources, history --> Observer --> Proposal --> (a person) --> Adapt --> outcome

| symptom                                | is read from                                                     |
|----------------------------------------|------------------------------------------------------------------|
| divergence, value_fault, detected_stop | the journals of nodes that host an After                         |
| crash, hang                            | the `alarm` that the supervisor logs when a replica is lost      |

**Time.** The loop observes every `PERIOD_SECONDS`. A symptom counts from when it was journalled, and
`consistent_after_ms` runs from there: from the first event (or sample) of what triggered it until the run
reports that it is adapted.

**One at a time.** While a proposal waits for its answer, another one is dropped: what still holds is proposed
again after the dwell time. While a person is asked, a different proposal replaces the open one.

Limits. A detected stop of a duplex is seen twice, as such and as a crash, because it ends in a failover. A
node that no Watchdog watches (Proxy, Recovery, Engine) is replaced and is no symptom. What replicas send
each other is not measured: on one host nothing limits it, and no journal contains its size. Of each node
the newest `INCARNATIONS` journals are read.
"""

import contextlib
import os
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Literal

import msgspec

from aftbed import adapt
from aftbed.adapt.policy import (
    Beyond,
    Declined,
    Measured,
    Observation,
    Observer,
    Policy,
    PolicyFile,
    Proposal,
    Resource,
    Running,
    Seen,
    policy_from,
    symptoms,
)
from aftbed.adapt.suitability import unsuitable
from aftbed.core import journal
from aftbed.core.application import Characteristics
from aftbed.core.errors import AftbedError, ConfigError, FileKeyError, PeerError, unknown
from aftbed.core.input_file import read_input
from aftbed.core.journal import Record
from aftbed.core.messages import Goal
from aftbed.ftm.compose import NONE
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.unix import control_client, linux
from aftbed.runtime.unix.control_client import Answer
from aftbed.runtime.unix.options import RunOptions
from aftbed.runtime.unix.run_directory import HISTORY_NAME
from aftbed.runtime.unix.transport import Line
from aftbed.vehicle.aeb.function import default_application

PERIOD_SECONDS: Final = 0.1
PROPOSALS_NAME: Final = "proposals.jsonl"
REPORT_NAME: Final = "policy.json"
PROPOSALS_BYTES_MAX: Final = 64_000_000
APPROVALS: Final = ("auto", "ask")
SETTLED: Final = ("done", "declined", "superseded")  # outcomes of proposals after which nothing is left to do
MEASURED: Final[tuple[Resource, ...]] = ("cpus", "cpu_load")
LOAD_SAMPLES: Final = 10  # CPU load is that of the last second

FIRST_BYTES: Final = journal.HEADER_BYTES + journal.RECORD.size
CODE_BYTES: Final = 4  # at the end of a record
CHUNK_BYTES: Final = 2048 * journal.RECORD.size
HISTORY_BYTES_MAX: Final = 1 << 20  # that are read at once
INCARNATIONS: Final = 2
REPLICA_NODES: Final = ("a", "b", "single")

_FOLDER: Final = Path(adapt.__file__).resolve().parent / "policies"

Show = Callable[[dict[str, object]], None]
State = Literal["free", "asking", "adapting"]


class Proposed(msgspec.Struct, frozen=True):
    """A proposal that has come to its end.

    `outcome`: done, rolled back, refused, declined, superseded, cut off.
    `t_ms`: since the start of the run; `consistent_after_ms`: from the change that triggered it, if done.
    """

    t_ms: float
    rule: str
    reason: str
    action: str
    running: str
    target: str
    outcome: str
    why: str = ""
    consistent_after_ms: float | None = None


class RuleReport(msgspec.Struct, frozen=True):
    """What became of a rule: how often it was evaluated, whether its condition held, what it proposed."""

    rule: str
    when: str
    then: str
    observations: int
    held: bool
    proposed: int


class PolicyReport(msgspec.Struct, frozen=True):
    """How a policy was followed, written when the run has ended. `trouble`: why not to its end."""

    rules: tuple[RuleReport, ...]
    trouble: str = ""


# -- before the run -------------------------------------------------------------------------------


def policy_names() -> list[str]:
    """The policies that are shipped."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def load_policy(name_or_path: str) -> Policy:
    """A shipped policy by name, or a file by path: whatever has a slash or ends in .yaml or .yml."""
    from aftbed.core.yaml_file import in_file, read_yaml  # noqa: PLC0415 - PyYAML costs 15 ms

    if "/" in name_or_path or name_or_path.endswith((".yaml", ".yml")):
        path = Path(name_or_path)
    elif name_or_path in policy_names():
        path = _FOLDER / f"{name_or_path}.yaml"
    else:
        raise unknown("policy", name_or_path, policy_names())
    file = read_yaml(path, PolicyFile)
    with in_file(path):
        policy = policy_from(file)
        for rule in policy.rules:
            if isinstance(rule.when, Beyond) and rule.when.resource not in MEASURED:
                raise FileKeyError(
                    f"{rule.key}.when.resource",
                    f"found {rule.when.resource}, which no run measures; measured are: {', '.join(MEASURED)}",
                )
    return policy


def asked_for(policy: str | None, approve: str, ftm: str, *, as_json: bool) -> Policy | None:
    """The policy that `aftbed run` asks for, if any. Raises ConfigError."""
    if approve not in APPROVALS:
        raise unknown("approval", approve, APPROVALS)
    if policy is None:
        if approve != APPROVALS[0]:
            raise ConfigError("--approve says what becomes of the proposals of a policy: give --policy too")
        return None
    if ftm == NONE:
        raise ConfigError(f"--policy {policy}: {NONE} has no Engine, so nothing leads away from it")
    if approve == "ask" and as_json:
        raise ConfigError("--approve ask: --json prints no question; leave one of them out")
    if approve == "ask" and not sys.stdin.isatty():
        raise ConfigError("--approve ask: standard input is no terminal, so no question can be answered")
    return load_policy(policy)


# -- what is observed -----------------------------------------------------------------------------


class Tail:
    """Reads what was committed to a journal since the last call: each record once, and complete.

    Journals grow while they are read. A record is committed by its event code, which is written last, so
    whatever stands before the first record without one is complete.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._at, self._header = path, journal.HEADER_BYTES, b""

    def new(self) -> list[Record]:
        """The new records. Raises PeerError on what is no journal."""
        found: list[Record] = []
        with open(self._path, "rb") as file:
            if not self._header:
                first = file.read(FIRST_BYTES)
                if len(first) < FIRST_BYTES or not any(first[-CODE_BYTES:]):
                    return found  # before its first record, a node may still write the header
                self._header = first[: journal.HEADER_BYTES]
            file.seek(self._at)
            full = True
            while full:
                some = list(journal.records(self._header + file.read(CHUNK_BYTES)))
                found += some
                self._at += len(some) * journal.RECORD.size
                full = len(some) * journal.RECORD.size == CHUNK_BYTES
        return found


class Journals:
    """The tails of all journals that can contain a symptom."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._tails: dict[Path, Tail] = {}

    def new(self) -> list[Record]:
        """What is new in the newest journals of each node that hosts an After, by time. Raises PeerError."""
        nodes: dict[str, list[tuple[int, Path]]] = {}
        for path in self._folder.glob("*.journal"):
            node, _, incarnation = path.name.removesuffix(".journal").rpartition(".")
            if node in REPLICA_NODES or node.endswith("after"):
                nodes.setdefault(node, []).append((int(incarnation), path))
        wanted = [path for found in nodes.values() for _, path in sorted(found)[-INCARNATIONS:]]
        self._tails = {path: self._tails.get(path) or Tail(path) for path in wanted}
        records = [record for tail in self._tails.values() for record in tail.new()]
        return sorted(records, key=lambda record: record.t_ns)


class AdaptationHistory:
    """Reads the adaptations that ended since the last call."""

    def __init__(self, path: Path) -> None:
        self._path, self._at = path, 0

    def new(self) -> list[Outcome]:
        """The lines that are complete."""
        if not self._path.exists():
            return []
        with open(self._path, "rb") as file:
            file.seek(self._at)
            whole, end, _ = file.read(HISTORY_BYTES_MAX).rpartition(b"\n")
        self._at += len(whole) + len(end)
        return [msgspec.json.decode(line, type=Outcome) for line in whole.splitlines()]


def loss_in(event: str, text: str) -> Seen | None:
    """A replica's loss, by its cause, if that is what the supervisor logs: `alarm`, `a: crash`."""
    if event != "alarm":
        return None
    return Seen("crash") if text.endswith(": crash") else Seen("hang")


class Meter:
    """Measures the resources that a policy names, and no others."""

    def __init__(self, policy: Policy) -> None:
        self._wanted = {rule.when.resource for rule in policy.rules if isinstance(rule.when, Beyond)}
        self._samples: deque[tuple[float, float]] = deque(maxlen=LOAD_SAMPLES + 1)  # busy, all; seconds

    def values(self) -> dict[Resource, float]:
        """The present values; the CPU load is unknown at the first call."""
        found: dict[Resource, float] = {}
        if "cpus" in self._wanted:
            found["cpus"] = float(len(os.sched_getaffinity(0)))
        if "cpu_load" in self._wanted:
            self._samples.append(_cpu_seconds())
            (busy_s, all_s), (busy_now_s, now_s) = self._samples[0], self._samples[-1]
            if now_s > all_s:
                found["cpu_load"] = (busy_now_s - busy_s) / (now_s - all_s)
        return found


def _cpu_seconds() -> tuple[float, float]:
    """CPU seconds, busy and total, of all CPUs since the boot. Guests are in `user` already."""
    import psutil  # noqa: PLC0415 - 15 ms, if a policy asks for it

    t = psutil.cpu_times()
    busy = t.user + t.nice + t.system + t.irq + t.softirq + t.steal
    return busy, busy + t.idle + t.iowait


# -- the loop -------------------------------------------------------------------------------------


class ClosedLoop:
    """One run under a policy. Assign `show` to have its lines shown like the events of the run."""

    def __init__(
        self, policy: Policy, options: RunOptions, approve: str, declared_by: Callable[[str], Characteristics]
    ) -> None:
        """`declared_by` is asked for the characteristics of a function outside of the package."""
        private, record, ftm = Path(options.private), Path(options.record), options.ftm
        self._private, self._approve, self._declared_by = private, approve, declared_by
        self._started_ns = time.monotonic_ns()
        self._policy, self._observer = policy, Observer(policy, ftm, self._started_ns)
        self._journals, self._meter = Journals(record / "journal"), Meter(policy)
        self._history = AdaptationHistory(record / HISTORY_NAME)
        self._record = record
        self._observations: Counter[str] = Counter()  # by rule
        self._proposed: Counter[str] = Counter()  # by rule
        self._trouble = ""
        self.show: Show = lambda _: None
        self.reads_input = True  # answers are read here; else `decide` is called with them
        self._application = options.application
        self._clock_known = False  # an event has shown when the run's clock began
        self._input_ended = False
        self._open: Proposal | None = None  # waits for a person, or for the run
        self._line: Line[Answer] | None = None  # by which the run will answer
        self._due_ns = self._asked_ns = self._started_ns

    @property
    def state(self) -> State:
        if self._open is None:
            return "free"
        return "asking" if self._line is None else "adapting"

    def wait(self, descriptors: Sequence[int]) -> set[int]:
        """Observe until one of `descriptors` is readable, or for a period; those that are."""
        now_ns = time.monotonic_ns()
        if now_ns >= self._due_ns:
            self._due_ns = now_ns + round(PERIOD_SECONDS * 1e9)
            self._observe(now_ns)
        own = [self._line.fileno()] if self._line is not None else []
        if self.state == "asking" and self.reads_input:
            own.append(sys.stdin.fileno())
        wait_s = max(0, self._due_ns - time.monotonic_ns()) / 1e9
        ready = linux.readable((*descriptors, *own), wait_s)
        if self._line is not None and self._line.fileno() in ready:
            self._take_answer(self._line)
        if self.state == "asking" and sys.stdin.fileno() in ready & set(own):
            self._take_typed()
        return ready & set(descriptors)

    def on_event(self, event: dict[str, object]) -> None:
        """Show an event of the run; its time gives the start of the run's clock."""
        now_ns = time.monotonic_ns()
        zero_ns = now_ns - round(float(str(event["t_ms"])) * 1e6)
        self._started_ns = min(zero_ns, self._started_ns) if self._clock_known else zero_ns
        self._clock_known = True
        if seen := loss_in(str(event["event"]), str(event["text"])):
            self._step(seen, now_ns)

    def close(self) -> None:
        """End what is open, and report how the policy was followed."""
        if self._line is not None and linux.readable((self._line.fileno(),), 0):
            self._take_answer(self._line)
        if self._open is not None:
            self._end(self._open, "cut off", "the run ended before")
        rules = [
            RuleReport(
                rule.key,
                str(rule.when),
                str(rule.then),
                self._observations[rule.key],
                rule.key in self._observer.held,
                self._proposed[rule.key],
            )
            for rule in self._policy.rules
        ]
        report = PolicyReport(tuple(rules), self._trouble)
        with contextlib.suppress(OSError):  # then there is no report, which the judge tells
            (self._record / REPORT_NAME).write_bytes(msgspec.json.format(msgspec.json.encode(report)))

    # -- observing ----------------------------------------------------------------------------

    def _observe(self, now_ns: int) -> None:
        """Step the Observer with what is new; the history first, because it shows which FTM runs."""
        if self._line is not None and now_ns - self._asked_ns > control_client.ADAPT_SECONDS_MAX * 1e9:
            self._take_answer(self._line)
        for outcome in self._history.new():
            self._application = outcome.application
            if outcome.ftm != self._observer.running and self._open is not None and self._line is None:
                self._end(self._open, "superseded", f"{outcome.ftm} runs now")
            self._step(Running(outcome.ftm), now_ns)
        for record in self._records():
            for symptom in symptoms(record.event, record.detail):
                self._step(Seen(symptom), record.t_ns)
        values = self._meter.values()
        self._step(Measured(values), now_ns)
        for rule in self._policy.rules:
            seen = rule.when.resource in values if isinstance(rule.when, Beyond) else not self._trouble
            self._observations[rule.key] += seen

    def _records(self) -> list[Record]:
        """What is new in the journals; nothing any more once one of them could not be read."""
        if self._trouble:
            return []
        try:
            return self._journals.new()
        except (PeerError, OSError, ValueError) as error:
            self._trouble = f"the policy sees no value faults any more: {error}"
            self._log("trouble", self._trouble)
            return []

    def _step(self, observation: Observation, now_ns: int) -> None:
        if proposal := self._observer.step(observation, now_ns):
            self._propose(proposal)

    # -- proposing ----------------------------------------------------------------------------

    def _propose(self, proposal: Proposal) -> None:
        old = self._open
        if self.state == "adapting":
            return
        if old is not None:
            if (old.rule, old.since_ns, old.target) == (proposal.rule, proposal.since_ns, proposal.target):
                return
            self._end(old, "superseded", f"{proposal.target} is proposed instead")
        self._open = proposal
        change = f"{proposal.running} to {proposal.target}"
        self._log("proposed", f"{proposal.action}: {change} ({proposal.reason})")
        if self._approve == "auto":
            self._carry_out(proposal)
        elif self._input_ended:
            self._decline(proposal)
        else:
            self._log("question", f"{proposal.action}? y or n")

    def _take_typed(self) -> None:
        typed = os.read(sys.stdin.fileno(), 4096)
        self._input_ended = not typed
        self.decide(typed.decode(errors="replace").strip().lower() if typed else "n")

    def decide(self, word: str) -> None:
        """The answer of a person; nothing happens if there is no question."""
        if self._open is None or self.state != "asking":
            return
        if word in ("y", "yes"):
            self._carry_out(self._open)
        elif word in ("n", "no"):
            self._decline(self._open)
        else:
            self._log("question", f"{self._open.action}? y or n; found {word[:20]!r}")

    def _decline(self, proposal: Proposal) -> None:
        self._end(proposal, "declined")
        self._step(Declined(), time.monotonic_ns())

    def _carry_out(self, proposal: Proposal) -> None:
        """Send it to the run, which answers later."""
        try:
            if reason := self._unsuitable(proposal.target):
                raise ConfigError(reason)
            goal = Goal(expression=proposal.target, may_fail=True)
            command = control_client.AdaptCommand(goal)
            self._line = control_client.send(self._private, command)
            self._asked_ns = time.monotonic_ns()
        except AftbedError as error:
            self._end(proposal, "refused", str(error))

    def _take_answer(self, line: Line[Answer]) -> None:
        """Handle the run's answer, its end, or the missed deadline of an answer."""
        proposal, self._line = self._open, None
        assert proposal is not None
        try:
            outcome = msgspec.convert(control_client.receive(line, PERIOD_SECONDS), Outcome)
        except ConfigError as error:
            self._end(proposal, "refused", str(error))
        except AftbedError as error:
            self._end(proposal, "cut off", str(error))
        else:
            self._end(proposal, outcome.outcome, outcome.reason)

    def _end(self, proposal: Proposal, outcome: str, why: str = "") -> None:
        """Record and show the end of a proposal. Which FTM runs then is read from the history."""
        self._open = None
        self._proposed[proposal.rule] += 1
        ended = Proposed(
            round((proposal.now_ns - self._started_ns) / 1e6, 3),
            proposal.rule,
            proposal.reason,
            proposal.action,
            proposal.running,
            proposal.target,
            outcome,
            why,
            _ms_since(proposal.since_ns) if outcome == "done" else None,
        )
        with open(self._record / PROPOSALS_NAME, "ab") as file:
            file.write(msgspec.json.encode(ended) + b"\n")
        self._log("proposal", proposed_line(ended))

    def _unsuitable(self, expression: str) -> str:
        """Why `expression` does not suit the function that is protected now; "" if it does."""
        application = self._application
        try:
            declared = (
                self._declared_by(application) if application else default_application().characteristics
            )
        except ConfigError as error:
            return str(error)
        return unsuitable(expression, declared)

    def _log(self, event: str, text: str) -> None:
        self.show({"t_ms": _ms_since(self._started_ns), "event": event, "text": text})


def _ms_since(t_ns: int) -> float:
    return round((time.monotonic_ns() - t_ns) / 1e6, 3)


def proposed_line(ended: Proposed) -> str:
    """A proposal and its end, for people."""
    after = ended.consistent_after_ms
    tail = f", consistent after {after:.1f} ms" if after is not None else ""
    why = f": {ended.why}" if ended.why else ""
    return f"{ended.running} to {ended.target} ({ended.reason}): {ended.outcome}{why}{tail}"


def rule_line(one: RuleReport) -> str:
    """What became of a rule, for people."""
    held = _counted(one.proposed, "proposal") if one.proposed else "held" if one.held else "never held"
    return f"{one.when}, then {one.then}: {held} in {_counted(one.observations, 'observation')}"


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'s' if number != 1 else ''}"


def read_proposals(record: Path) -> list[Proposed]:
    """The proposals of a recorded run. Raises ConfigError naming the file."""
    path = record / PROPOSALS_NAME
    try:
        lines = read_input(path, PROPOSALS_BYTES_MAX).splitlines()
        return [msgspec.json.decode(line, type=Proposed) for line in lines]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not the proposals of a run: {error}") from None


def read_policy_report(record: Path) -> PolicyReport | None:
    """How the policy of a recorded run was followed, if it had one. Raises ConfigError naming the file."""
    path = record / REPORT_NAME
    try:
        return msgspec.json.decode(read_input(path, PROPOSALS_BYTES_MAX), type=PolicyReport)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not the report of a policy: {error}") from None
