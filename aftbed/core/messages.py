"""The messages between bricks, and between a brick and the runtime: closed unions of frozen structs.

Every message on the request path carries the `epoch`: the number of the mastership under which it was sent.
It grows by one at each failover; a brick that receives an older one refuses it (G6). The payloads of requests
and replies are opaque bytes: no mechanism looks into them.

A message between nodes is one packet: MessagePack, tagged, typed, limited in size; never pickle. A packet
over the limit, truncated, of an unknown tag or of a wrong type raises PeerError; nothing is half decoded.
"""

from collections.abc import Callable
from enum import Enum
from typing import ClassVar, Final

import msgspec

from aftbed.core.errors import PeerError
from aftbed.core.script import Phase, Script
from aftbed.core.units import duration


class Traffic(Enum):
    """What kind of traffic a message is, to a reader of a trace."""

    REQUEST = "request"
    REPLY = "reply"
    STATE = "state"
    CONTROL = "control"


class Loss(Enum):
    """How a replica was lost. What hangs may go on; what crashed does not."""

    CRASH = "crash"
    HANG = "hang"


class Message(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """Base of all messages: an array on the wire, its tag first."""

    TRAFFIC: ClassVar[Traffic] = Traffic.CONTROL


class Request(Message, frozen=True, tag=1):
    """`payload` for the protected function. Ids start at 1 and grow by 1."""

    TRAFFIC = Traffic.REQUEST
    epoch: int
    request_id: int
    payload: bytes


class Reply(Message, frozen=True, tag=2):
    """The answer to request `request_id`, given by replica number `replica` (1 or 2)."""

    TRAFFIC = Traffic.REPLY
    epoch: int
    request_id: int
    replica: int
    payload: bytes


class Pages(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """The state of a checkpoint, `state_bytes` long: what of it differs from that of checkpoint `base`.

    A page is `page_bytes` long, but for the last. `numbers`: those in `data`, in ascending order. With `base`
    0 `data` is the whole state. `check`: a CRC-32 of all of this (`ftm.pages`).
    """

    state_bytes: int
    base: int
    page_bytes: int
    numbers: tuple[int, ...]
    data: bytes
    check: int


State = bytes | Pages  # of a checkpoint; a small one always travels as bytes


class CaptureState(Message, frozen=True, tag=3):
    """Asks the Server for its state: after exactly request `request_id`, or before it.

    `base`: a checkpoint, by its request; what has changed since is enough. 0: the whole state is wanted.
    """

    TRAFFIC = Traffic.STATE
    epoch: int
    request_id: int
    base: int = 0


class StateCaptured(Message, frozen=True, tag=4):
    """The Server's answer to CaptureState."""

    TRAFFIC = Traffic.STATE
    epoch: int
    request_id: int
    state: State


class Checkpoint(Message, frozen=True, tag=5):
    """Primary to backup: the state after `request_id`, and the reply that the client will get."""

    TRAFFIC = Traffic.STATE
    epoch: int
    request_id: int
    reply: bytes
    state: State


class RestoreState(Message, frozen=True, tag=6):
    """After of the backup to its Server: the state of a checkpoint."""

    TRAFFIC = Traffic.STATE
    epoch: int
    request_id: int
    state: State


class StateRestored(Message, frozen=True, tag=7):
    """The Server's answer to RestoreState."""

    TRAFFIC = Traffic.STATE
    epoch: int
    request_id: int


class StoreReply(Message, frozen=True, tag=8):
    """After of a backup to its Protocol: a reply to keep."""

    TRAFFIC = Traffic.REPLY
    epoch: int
    request_id: int
    payload: bytes


class TakeOver(Message, frozen=True, tag=9):
    """All that came before in this channel is applied: lead, under this epoch.

    It goes the way of a request, from the brick that was promoted on. Each brick hands it on.
    """

    epoch: int


class Suspect(Message, frozen=True, tag=10):
    """A Watchdog to Recovery: `node` of this generation of `replica` is dead or hangs."""

    replica: str
    generation: int
    node: str
    cause: Loss
    at_ns: int


class Notification(Message, frozen=True, tag=11):
    """LFR, leader to follower: the client gets the reply to `request_id`, which has this digest."""

    TRAFFIC = Traffic.REPLY
    epoch: int
    request_id: int
    digest: bytes


class Trial(Message, frozen=True, tag=12):
    """TR: one execution of `payload`. A `rerun` starts from `state`, from which the first run started."""

    TRAFFIC = Traffic.REQUEST
    epoch: int
    request_id: int
    payload: bytes
    state: bytes
    rerun: bool


class Tried(Message, frozen=True, tag=13):
    """The result of one Trial: the reply, and the state after it."""

    TRAFFIC = Traffic.REPLY
    epoch: int
    request_id: int
    replica: int
    payload: bytes
    state: bytes


class Trials(Message, frozen=True, tag=14):
    """TR, Proceed to After: two results to compare, or the third one."""

    TRAFFIC = Traffic.REPLY
    epoch: int
    request_id: int
    tried: tuple[Tried, ...]


class Again(Message, frozen=True, tag=15):
    """TR, After to Proceed: two trials differ, run a third."""

    TRAFFIC = Traffic.REQUEST
    epoch: int
    request_id: int


class Promotion(Message, frozen=True, tag=20):
    """Runtime to the brick of a backup that receives from its leader: drain to the end, then take over."""

    epoch: int


class Promoted(Message, frozen=True, tag=21):
    """The backup's Protocol to the runtime: this replica leads now."""

    epoch: int


class Rebound(Message, frozen=True, tag=22):
    """Runtime to a brick: output `port` is bound to another channel, or to none; the epoch from here on."""

    port: str
    bound: bool
    epoch: int


class ChannelEnded(Message, frozen=True, tag=23):
    """Host to a brick: the port's channel is drained to its end."""


class Submit(Message, frozen=True, tag=24):
    """The source of requests to the Client."""

    payload: bytes


class Watch(Message, frozen=True, tag=25):
    """Runtime to a Watchdog: the nodes of this generation of the replica."""

    replica: str
    generation: int
    nodes: tuple[str, ...]


class NodeDied(Message, frozen=True, tag=26):
    """Host to a Watchdog: the pidfd of a watched node became readable."""

    node: str


class SeenAlive(Message, frozen=True, tag=27):
    """Host to a Watchdog: it looked at `at_ns`, `late_ns` later than planned, and had last seen each watched
    node alive at `seen_ns` (all monotonic). The Watchdog itself may come to run a good while after `at_ns`.
    """

    at_ns: int
    seen_ns: dict[str, int]
    late_ns: int


class Situation(Message, frozen=True, tag=28):
    """Runtime to Recovery: which replica leads, which backs up (`""`: none), which slots are empty.

    Sent at the start and after each script, done or `failed`; so a new Recovery needs no memory of the old
    one. `replication`: parts and ports by which a leader sends to its backup. `stateful`: the parts whose
    state a new backup needs. `lost`: replicas that are to be treated as dead, though no Watchdog reports it.
    """

    leader: str
    leader_generation: int
    backup: str
    backup_generation: int
    epoch: int
    vacant: tuple[str, ...]
    failed: bool
    replication: tuple[tuple[str, str], ...] = (("after", "aft2aft"),)
    stateful: tuple[str, ...] = ("protocol", "server")
    lost: tuple[str, ...] = ()


class Goal(msgspec.Struct, frozen=True):
    """The goal of an adaptation: one of `expression`, `part` with `source`, or `script`.

    `file`: where the script was read, for messages to the user. If it `may_fail`, the verdict does not demand
    that it is done.
    """

    expression: str = ""
    part: str = ""
    source: str = ""
    script: Script | None = None
    recipe: str = "drained"
    file: str = ""
    may_fail: bool = False

    def __str__(self) -> str:
        if self.script is not None:
            return f"script {self.file or self.script.purpose}"
        return f"update {self.part} to {self.source}" if self.part else f"to {self.expression}"


class Scheduled(msgspec.Struct, frozen=True):
    """An adaptation that begins when request `at_request` is sent, or `after_ms` after the launch."""

    goal: Goal
    at_request: int = 0
    after_ms: float = 0.0

    def __str__(self) -> str:
        if self.at_request:
            return f"{self.goal} at request {self.at_request}"
        return f"{self.goal} after {duration(self.after_ms)}" if self.after_ms else str(self.goal)


class Adapt(Message, frozen=True, tag=40):
    """Runtime to the Engine: adaptation `number`, as it was planned."""

    number: int
    script: Script


class Progress(Message, frozen=True, tag=41):
    """Runtime to the Engine: a phase that it ordered has ended. `failure`: `""` or the reason."""

    number: int
    phase: Phase
    failure: str


class TakeUp(Message, frozen=True, tag=42):
    """Runtime to a new Engine: what the dead one had ordered last, and how that ended, if it has."""

    number: int
    script: Script
    phase: Phase
    ended: bool
    failure: str


class Adapted(Message, frozen=True, tag=43):
    """The Engine to the runtime: how adaptation `number` ended: done, refused, rolled back."""

    number: int
    outcome: str
    reason: str


class HoldAt(Message, frozen=True, tag=44):
    """Runtime to the Client: report these requests, and send each of them only when it is released."""

    requests: tuple[int, ...]


class RequestHeld(Message, frozen=True, tag=45):
    """The Client to the runtime: it has come to `request_id`, and waits for its Release."""

    request_id: int


class Release(Message, frozen=True, tag=46):
    """Runtime to the Client: send `request_id`, if it is held."""

    request_id: int


class Redundancy(Message, frozen=True, tag=47):
    """Runtime to a brick of the leader (`BrickKind.told_redundancy`), in `epoch`: is this replica `alone`,
    although its mechanism has a backup?
    """

    epoch: int
    alone: bool


WireMessage = (  # between bricks
    Request
    | Reply
    | CaptureState
    | StateCaptured
    | Checkpoint
    | RestoreState
    | StateRestored
    | StoreReply
    | TakeOver
    | Suspect
    | Notification
    | Trial
    | Tried
    | Trials
    | Again
)
AnyMessage = (  # all that a brick may receive
    WireMessage
    | Promotion
    | Promoted
    | Rebound
    | ChannelEnded
    | Submit
    | Watch
    | NodeDied
    | SeenAlive
    | Situation
    | Adapt
    | Progress
    | TakeUp
    | HoldAt
    | Release
    | Redundancy
)


# -- packets --------------------------------------------------------------------------------------

PACKET_BYTES_MAX: Final = 64 * 1024
UNREADABLE: Final = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)  # all that a decoder raises

# For the hot path of a host, which checks the size and the errors itself.
encode_unchecked: Callable[[Message], bytes] = msgspec.msgpack.Encoder().encode
decode_unchecked: Callable[[bytes | memoryview], WireMessage] = msgspec.msgpack.Decoder(WireMessage).decode


def encode(message: Message) -> bytes:
    """The packet of `message`; asserts that it keeps the limit (ours to keep, not the peer's)."""
    data = encode_unchecked(message)
    assert len(data) <= PACKET_BYTES_MAX, f"{type(message).__name__} of {len(data)} bytes"
    return data


def decode(data: bytes) -> WireMessage:
    """The message in `data`. Raises PeerError."""
    if len(data) > PACKET_BYTES_MAX:
        raise PeerError(f"packet of {len(data)} bytes, at most {PACKET_BYTES_MAX} are allowed")
    try:
        return decode_unchecked(data)
    except UNREADABLE as error:
        raise PeerError(f"not a message ({len(data)} bytes): {error}") from error
