"""The messages between the executive and the nodes.

Each order carries a token; its answer is `Ack` with the same token, so an order without an answer is
noticed by its deadline. How it travels, and ends of channels with it, is the runtime's affair.
"""

from typing import Final

import msgspec

from aftbed.core.graph import BrickSpec, Graph
from aftbed.core.messages import (
    Adapt,
    Adapted,
    HoldAt,
    Progress,
    Promoted,
    Promotion,
    Rebound,
    Redundancy,
    Release,
    RequestHeld,
    Situation,
    TakeUp,
    Watch,
)
from aftbed.core.script import Phase, Script
from aftbed.inject.bus import BusFault
from aftbed.inject.model import ArmedFault
from aftbed.inject.radar import RadarFault
from aftbed.vehicle.condition import Condition

WHOLE: Final = 1.0  # of a CPU
UNANSWERED: Final = 0  # the token of an order that gets no Ack

ToBrick = Promotion | Rebound | Watch | Situation | Redundancy | Adapt | Progress | TakeUp | HoldAt | Release
FromBrick = Promoted | Adapted | RequestHeld  # from a brick to the executive
NOWHERE: Final = -1  # the index of a port that is to lead nowhere


class Port(msgspec.Struct, frozen=True):
    """An end of a channel at a brick: the descriptor at `index` among those that came along, or NOWHERE."""

    brick: str
    port: str
    index: int


class Local(msgspec.Struct, frozen=True):
    """A channel between two bricks of one node."""

    brick: str
    port: str
    sink: str
    sink_port: str


class ControlOrder(msgspec.Struct, frozen=True, tag=True):
    """Base of what the executive sends; `token` comes back in the Ack, if it is not UNANSWERED."""

    token: int


class Park(ControlOrder, frozen=True):
    """To a zygote: fork one spare for each descriptor that came along.

    Before, it imports `mechanisms`, those of installed packages, and what functions of the kind of
    `application` need.
    """

    mechanisms: tuple[str, ...] = ()
    application: str = ""


class JoinRun(ControlOrder, frozen=True):
    """To a zygote that was forked before there was a run: belong to the one in `private`, and print to the
    file that came along.
    """

    private: str


class SelfTest(msgspec.Struct, frozen=True):
    """A self-test: the graph to be, and requests that were recorded in this run."""

    graph: Graph
    requests: tuple[bytes, ...]


class Assign(ControlOrder, frozen=True):
    """To a spare: be this node."""

    node: str
    journal: str
    bricks: tuple[BrickSpec, ...]
    epoch: int
    leader: str
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    locals: tuple[Local, ...]
    cpu: int | None
    held: bool = False  # take no mail before a Resume
    staged: bool = False  # it serves later
    aside: int | None = None  # the core on which a staged node is made
    rehearse: bool = False  # before it joins: see Rehearse
    trial: SelfTest | None = None  # what is written off line must stand before it is wired
    device: str = ""  # see `devices`
    options: bytes = b""


class Rehearse(ControlOrder, frozen=True):
    """To a node that has nothing to do, or not what it will do, until a failover or a commit: do once in
    private what bricks of these kinds do then, so that the node takes no page faults then. Simulated nodes
    have no pages, and do nothing.
    """

    kinds: tuple[str, ...]


class Serve(ControlOrder, frozen=True):
    """To a spare: run the service called `service` (the hub, the vehicle) with these options."""

    service: str
    options: bytes


class BindInput(ControlOrder, frozen=True):
    """Read `port` from the descriptor that came along, or from nowhere."""

    brick: str
    port: str


class BindOutput(ControlOrder, frozen=True):
    """Write `port` to the descriptor that came along, or to nowhere; `epoch` is in force from here."""

    brick: str
    port: str
    epoch: int


class Follow(ControlOrder, frozen=True):
    """To the Proxy: follow a new leader; `input` is the first descriptor, `output` the second."""

    brick: str
    input: str
    output: str
    epoch: int


class Rewire(ControlOrder, frozen=True):
    """All that changes at this node's ports in one adaptation; then, if `suspend`, Suspend."""

    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    epoch: int
    suspend: bool


class SuspendNode(ControlOrder, frozen=True):
    """Finish what is inside (`drain`: and all that waits at the open ports), take no more, then answer."""

    drain: bool = False


class ResumeNode(ControlOrder, frozen=True):
    """Undo Suspend."""


class Capture(ControlOrder, frozen=True):
    """Answer with the state of `brick`, or put it into the file that came along, if it is large."""

    brick: str
    look: bool = False  # at what is there; it is not going to be used


class Restore(ControlOrder, frozen=True):
    """Take over `state`, or what is in the file that came along.

    `migrate`: of a brick of another class, or with another function, perhaps.
    """

    brick: str
    state: bytes
    migrate: bool = False


class Deliver(ControlOrder, frozen=True):
    """Have `brick` step with `message` on its control port."""

    brick: str
    message: ToBrick


class WatchNodes(ControlOrder, frozen=True):
    """To the host of a Watchdog: watch the pidfds that came along, and the activity in these journals."""

    replica: str
    generation: int
    nodes: tuple[str, ...]
    journals: tuple[str, ...]
    pids: tuple[int, ...]


class Arm(ControlOrder, frozen=True):
    """These wait for `event` here, counted from now, beside those that do already; `nth` 0: no longer.

    Without an event: each disturbs what its brick sends on its channel, from the `nth` message on.
    """

    event: str
    faults: tuple[ArmedFault, ...]


class SlowDown(ControlOrder, frozen=True):
    """Because of `fault`, each step takes `by_ns` longer, and as much longer as with that share of a CPU.

    0 ns and the whole CPU: no longer.
    """

    fault: int
    by_ns: int
    share: float = WHOLE


class ShareState(ControlOrder, frozen=True):
    """Keep the state of a Server's function in the memory that came along; the answer is its StateLayout.

    `number` is in the records of what is found changed there.
    """

    brick: str
    number: int


class DisturbBus(ControlOrder, frozen=True):
    """To the hub: arm this fault of the bus; `token` is its number, `draw` seeds its chance."""

    fault: BusFault
    draw: int


class DisturbRadar(ControlOrder, frozen=True):
    """To the vehicle: arm this fault of its radar; `token` is its number, `draw` seeds its chance."""

    fault: RadarFault
    draw: int


class WatchCar(ControlOrder, frozen=True):
    """To the hub: report when `condition` holds; `token` is the number of the fault. An Ack has to follow."""

    condition: Condition


class Stop(ControlOrder, frozen=True):
    """To a service, or from the command: come to an end, with what there is so far."""


class StopRequests(ControlOrder, frozen=True):
    """To the client's host: hand in no more requests."""


class Stats(ControlOrder, frozen=True):
    """Answer with counts, as MessagePack."""


class Hello(msgspec.Struct, frozen=True, tag=True):
    """A spare to the supervisor: alive and parked."""

    pid: int


class Ack(msgspec.Struct, frozen=True, tag=True):
    """The answer to an order; `error` is empty where it was carried out."""

    token: int
    data: bytes = b""
    error: str = ""


class BrickReport(msgspec.Struct, frozen=True, tag=True):
    """A message of a brick to the executive."""

    brick: str
    message: FromBrick


class Ordered(msgspec.Struct, frozen=True, tag=True):
    """Recovery or the Engine to the runtime: execute this, or this phase of it."""

    brick: str
    script: Script
    phase: Phase = Phase.WHOLE
    number: int = 0


class Fired(msgspec.Struct, frozen=True, tag=True):
    """A host to the runtime: fault `fault` is due now; the host waits for the Ack with token `fault`."""

    fault: int


# Kinds of reports: of the Client's node about its load; of the hub about faults of the bus and conditions of
# the car; of the vehicle about those of its radar.
LOAD_ENDED: Final = "load.ended"  # all is asked and answered
HUB: Final = "hub"
BUS_FAULT_ARMED: Final = "disturbed"
BUS_FAULTS_CHANGED: Final = "struck"  # the receipts that are new
BUS_FAULTS_ASKED: Final = "struck.all"  # the receipts of all, as asked
CONDITION_WATCHED: Final = "watched"
CONDITION_MET: Final = "met"
RADAR_FAULT_ARMED: Final = "radar.disturbed"
RADAR_FAULTS_CHANGED: Final = "radar.struck"
BUS_COUNTS: Final = "counts"
BUS_STRANGER: Final = "stranger"
BUS_REPORTS: Final = (
    *(BUS_FAULT_ARMED, BUS_FAULTS_CHANGED, BUS_FAULTS_ASKED, CONDITION_WATCHED, CONDITION_MET),
    *(RADAR_FAULT_ARMED, RADAR_FAULTS_CHANGED, BUS_COUNTS, BUS_STRANGER),
)


class Report(msgspec.Struct, frozen=True, tag=True):
    """A service to the executive, or the executive to the command; `data` depends on `kind`."""

    kind: str
    data: bytes


# Kinds of reports to the command, besides `trouble`.
TELEMETRY: Final = "telemetry"  # a Telemetry of the vehicle
SIGHT: Final = "sight"  # a Sight of a replay
STATE: Final = "state"  # a ServiceState, when it is another one
EVENT: Final = "event"  # a line of the log, as JSON
FINISHED: Final = "finished"  # the last one: how it ended, as JSON


class RequestCounts(msgspec.Struct, frozen=True):
    """Requests that the Client has sent, and those of them that are answered."""

    sent: int
    answered: int


class ServiceState(msgspec.Struct, frozen=True):
    """What serves now; `leader` and `backup` are "" where there is none.

    `cycle_us`, from request to reply, and `requests` are the latest that are known.
    """

    ftm: str
    adapting: bool
    leader: str
    backup: str
    epoch: int
    cycle_us: float | None
    requests: RequestCounts | None

    @property
    def roles(self) -> str:
        """In words."""
        leads = f"{self.leader} leads" if self.leader else "no leader"
        backs_up = f"{self.backup} backs up" if self.backup else "no backup"
        return f"{leads}, {backs_up}, epoch {self.epoch}"


ToNode = (
    Park | JoinRun | Assign | Rehearse | Serve | BindInput | BindOutput | Follow | Rewire | SuspendNode
    | ResumeNode | Capture | Restore | Deliver | WatchNodes | Arm | SlowDown | ShareState | DisturbBus
    | DisturbRadar | WatchCar | Stop | StopRequests | Stats | Ack
)  # fmt: skip
FromNode = Hello | Ack | BrickReport | Ordered | Fired | Report
