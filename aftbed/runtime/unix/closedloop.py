"""The closed loop: the command of a run observes it, and has it adapted as a policy says (paper, II).

The `Observer` of `adapt.policy` decides and is pure; here is all I/O around it. The loop lives in the
command, not in the supervisor: it reads files and requests adaptations as any second terminal does, so a run
is the same with it and without it until the first adaptation.

    journals, events, resources, history --> Observer --> Proposal --> (a person) --> Adapt --> outcome

| symptom                                | is read from                                                     |
|----------------------------------------|------------------------------------------------------------------|
| divergence, value_fault, detected_stop | the journals of what hosts an After; a `Tail` each               |
| crash, hang                            | the `alarm` that the supervisor tells when a replica is lost     |

**Time.** A look every `PERIOD_SECONDS`. A symptom counts from when it was journalled, and
`consistent_after_ms` runs from there: from the first event (or sample) of what triggered it until the run
says that it is adapted.

**One at a time.** While a proposal waits for its answer, another one is dropped: what still holds is proposed
again after the dwell time. While a person is asked, a different proposal takes the place of the open one.

Limits. A detected stop of a duplex is seen twice, as such and as a crash, because it ends in a failover. A
node that no Watchdog watches (Proxy, Recovery, Engine) is replaced and is no symptom. What replicas send each
other is not measured: on one host nothing limits it, and no journal tells its size. Of each node the newest
`observation.INCARNATIONS` journals are read.
"""

import os
import select
import sys
import time
from collections.abc import Callable
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
    Running,
    Seen,
    policy_from,
    symptoms,
)
from aftbed.adapt.suitability import unsuitable
from aftbed.core.application import Characteristics
from aftbed.core.errors import AftbedError, ConfigError, PeerError, unknown
from aftbed.core.journal import Record
from aftbed.core.messages import Goal
from aftbed.ftm.compose import NONE
from aftbed.runtime.adaptations import Outcome
from aftbed.runtime.unix import control_client
from aftbed.runtime.unix.observation import MEASURED, Journals, Lines, Meter, lost
from aftbed.runtime.unix.support import HISTORY_NAME

PERIOD_SECONDS: Final = 0.1
PROPOSALS_NAME: Final = "proposals.jsonl"
APPROVALS: Final = ("auto", "ask")
_FOLDER: Final = Path(adapt.__file__).resolve().parent / "policies"

Tell = Callable[[dict[str, object]], None]


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


# -- before the run -------------------------------------------------------------------------------


def policy_names() -> list[str]:
    """The policies that are shipped."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def load_policy(name_or_path: str) -> Policy:
    """A shipped policy by name, or a file by path: whatever has a slash or ends in .yaml or .yml."""
    from aftbed.core.yaml_file import read_yaml  # noqa: PLC0415 - PyYAML costs 15 ms

    if "/" in name_or_path or name_or_path.endswith((".yaml", ".yml")):
        path = Path(name_or_path)
    elif name_or_path in policy_names():
        path = _FOLDER / f"{name_or_path}.yaml"
    else:
        raise unknown("policy", name_or_path, policy_names())
    policy = policy_from(read_yaml(path, PolicyFile), str(path))
    for rule in policy.rules:
        if isinstance(rule.when, Beyond) and rule.when.resource not in MEASURED:
            raise ConfigError(
                f"{path}: {rule.key}.when.resource: found {rule.when.resource}, which no run measures;"
                f" measured are: {', '.join(MEASURED)}"
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


def _unsuitable(expression: str, application: str) -> str:
    """Why `expression` does not suit the function that is protected now; "" if it does."""
    from aftbed.adapt.plugins import load_application  # noqa: PLC0415 - at the first proposal
    from aftbed.runtime.unix.part import load_module  # noqa: PLC0415
    from aftbed.vehicle.aeb.function import default_application  # noqa: PLC0415

    function = load_application(application, load_module) if application else default_application()
    declared: object = getattr(function, "characteristics", None)
    if not isinstance(declared, Characteristics):
        return f"{application}: characteristics: found {declared!r}, allowed is Characteristics(...)"
    return unsuitable(expression, declared)


# -- the loop -------------------------------------------------------------------------------------

State = Literal["free", "asking", "adapting"]


class ClosedLoop:
    """One run under a policy. `tell` shows a line, like the events of the run."""

    def __init__(self, policy: Policy, ftm: str, private: Path, record: Path, approve: str) -> None:
        self._private, self._approve = private, approve
        self._started_ns = time.monotonic_ns()
        self._observer = Observer(policy, ftm, self._started_ns)
        self._journals, self._meter = Journals(record / "journal"), Meter(policy)
        self._history = Lines(record / HISTORY_NAME)
        self._path = record / PROPOSALS_NAME
        self._path.touch()  # there is a policy, even if it proposes nothing
        self._tell: Tell = lambda _: None
        self._application = ""
        self._blind = self._deaf = self._timed = False
        self._open: Proposal | None = None  # waits for a person, or for the run
        self._waiting: control_client.Waiting | None = None
        self._due_ns = self._asked_ns = self._started_ns

    def show(self, tell: Tell) -> None:
        """Where lines go from here on."""
        self._tell = tell

    @property
    def state(self) -> State:
        """What it waits for."""
        if self._open is None:
            return "free"
        return "asking" if self._waiting is None else "adapting"

    def wait(self, descriptor: int) -> None:
        """Go on observing until `descriptor` is readable."""
        while True:
            now_ns = time.monotonic_ns()
            if now_ns >= self._due_ns:
                self._due_ns = now_ns + round(PERIOD_SECONDS * 1e9)
                self._look(now_ns)
            ready = self._ready(descriptor, max(0, self._due_ns - time.monotonic_ns()))
            if self._waiting is not None and self._waiting.fileno() in ready:
                self._answered()
            if self.state == "asking" and sys.stdin.fileno() in ready:
                self._decided()
            if descriptor in ready:
                return

    def _ready(self, descriptor: int, wait_ns: int) -> set[int]:
        """The descriptors that can be read, after a while at the latest."""
        poll = select.poll()
        poll.register(descriptor, select.POLLIN)
        if self._waiting is not None:
            poll.register(self._waiting.fileno(), select.POLLIN)
        elif self.state == "asking":
            poll.register(sys.stdin.fileno(), select.POLLIN)
        return {fd for fd, _ in poll.poll(wait_ns / 1e6)}

    def told(self, event: dict[str, object]) -> None:
        """An event of the run, as the view is told it; its time tells when the run's clock began."""
        now_ns = time.monotonic_ns()
        zero_ns = now_ns - round(float(str(event["t_ms"])) * 1e6)
        self._started_ns = min(zero_ns, self._started_ns) if self._timed else zero_ns
        self._timed = True
        if seen := lost(str(event["event"]), str(event["text"])):
            self._step(seen, now_ns)

    def close(self) -> None:
        """The run has ended."""
        if self._waiting is not None and self._waiting.fileno() in self._ready(self._waiting.fileno(), 0):
            self._answered()
        if self._open is not None:
            self._end(self._open, "cut off", "the run ended before")

    # -- observing ----------------------------------------------------------------------------

    def _look(self, now_ns: int) -> None:
        """Tell the Observer what is new. The history first: it says what runs."""
        if self.state == "adapting" and now_ns - self._asked_ns > control_client.ADAPT_SECONDS_MAX * 1e9:
            self._answered()
        for outcome in self._history.new():
            self._application = outcome.application
            if outcome.ftm != self._observer.running and self._open is not None and self._waiting is None:
                self._end(self._open, "superseded", f"{outcome.ftm} runs now")
            self._step(Running(outcome.ftm), now_ns)
        for record in self._records():
            for symptom in symptoms(record.event, record.detail):
                self._step(Seen(symptom), record.t_ns)
        self._step(Measured(self._meter.values()), now_ns)

    def _records(self) -> list[Record]:
        """What is new in the journals; none any more once one of them cannot be read."""
        if self._blind:
            return []
        try:
            return self._journals.new()
        except (PeerError, OSError, ValueError) as error:
            self._blind = True
            self._say("trouble", f"the policy sees no value faults any more: {error}")
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
        self._say("proposed", f"{proposal.action}: {change} ({proposal.reason})")
        if self._approve == "auto":
            self._carry_out(proposal)
        elif self._deaf:
            self._decline(proposal)
        else:
            self._say("question", f"{proposal.action}? y or n")

    def _decided(self) -> None:
        """A line was typed."""
        assert self._open is not None
        typed = os.read(sys.stdin.fileno(), 4096)
        self._deaf = not typed
        word = typed.decode(errors="replace").strip().lower()
        if word in ("y", "yes"):
            self._carry_out(self._open)
        elif self._deaf or word in ("n", "no"):
            self._decline(self._open)
        else:
            self._say("question", f"{self._open.action}? y or n; found {word[:20]!r}")

    def _decline(self, proposal: Proposal) -> None:
        self._end(proposal, "declined")
        self._step(Declined(), time.monotonic_ns())

    def _carry_out(self, proposal: Proposal) -> None:
        """Ask the run for it; the answer comes later."""
        try:
            if reason := _unsuitable(proposal.target, self._application):
                raise ConfigError(reason)
            self._waiting = control_client.send(
                self._private, control_client.AdaptCommand(Goal(expression=proposal.target))
            )
            self._asked_ns = time.monotonic_ns()
        except AftbedError as error:
            self._end(proposal, "refused", str(error))

    def _answered(self) -> None:
        """The run has answered, or has gone, or keeps silent for too long."""
        proposal, line, self._waiting = self._open, self._waiting, None
        assert proposal is not None and line is not None
        try:
            outcome = msgspec.convert(control_client.receive(line, PERIOD_SECONDS), Outcome)
        except ConfigError as error:
            self._end(proposal, "refused", str(error))
        except AftbedError as error:
            self._end(proposal, "cut off", str(error))
        else:
            self._end(proposal, outcome.outcome, outcome.reason)

    def _end(self, proposal: Proposal, outcome: str, why: str = "") -> None:
        """Tell it and write it down. What runs then is told by the history."""
        self._open = None
        after_ms = self._ms_since(proposal.since_ns) if outcome == "done" else None
        t_ms = round((proposal.now_ns - self._started_ns) / 1e6, 3)
        ended = Proposed(
            t_ms,
            proposal.rule,
            proposal.reason,
            proposal.action,
            proposal.running,
            proposal.target,
            outcome,
            why,
            after_ms,
        )
        with open(self._path, "ab") as file:
            file.write(msgspec.json.encode(ended) + b"\n")
        self._say("proposal", proposed_line(ended))

    def _ms_since(self, t_ns: int) -> float:
        return round((time.monotonic_ns() - t_ns) / 1e6, 3)

    def _say(self, event: str, text: str) -> None:
        self._tell({"t_ms": self._ms_since(self._started_ns), "event": event, "text": text})


def proposed_line(ended: Proposed) -> str:
    """A proposal and its end, for people."""
    after = ended.consistent_after_ms
    tail = f", consistent after {after:.1f} ms" if after is not None else ""
    why = f": {ended.why}" if ended.why else ""
    return f"{ended.running} to {ended.target} ({ended.reason}): {ended.outcome}{why}{tail}"


def read_proposals(record: Path) -> list[Proposed] | None:
    """The proposals of a recorded run; None if it had no policy. Raises ConfigError naming the file."""
    path = record / PROPOSALS_NAME
    if not path.exists():
        return None
    try:
        return [msgspec.json.decode(line, type=Proposed) for line in path.read_bytes().splitlines()]
    except msgspec.DecodeError as error:
        raise ConfigError(f"{path}: not the proposals of a run: {error}") from None
