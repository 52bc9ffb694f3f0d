"""The gateway: frames in, requests out; replies in, frames out. The paper's Client, without its sockets.

No content of a frame is used before its E2E protection is checked. Each RADAR_TRACK makes one
request, and the reply to it becomes one AEB_REQ: the radar is the clock of the function.

A RADAR_TRACK that is refused is counted, and not used. It still makes a request, with `radar_valid` False;
not one with no targets: "unknown" must never look like "the road is empty", which would end a braking.
Such a request is made only where the radar's cycle has a place for it: a repeated frame, or a flood of bad
ones, does not drive the function faster. An EGO_STATE that is missing or refused makes the ego speed of the
next request unknown.

The first frame of a run, or after a silence, only starts the E2E sequence, and is refused too.

The lateral selection is made here: a target farther than `LANE_HALF_M` from the middle of the lane is
not in our path and not in the request. The function knows range and speed only.
"""

from abc import ABC, abstractmethod
from collections import deque
from typing import Final

import msgspec

from aftbed.core.errors import PeerError
from aftbed.vehicle.aeb.messages import (
    COUNTER_COUNT,
    RANGE_MAX_M,
    SPEED_MAX_MS,
    AebInput,
    AebTarget,
    EncodeRequest,
    decode_reply,
    encode_request,
)
from aftbed.vehicle.can.bus_model import GOOD_AGAIN, Notice
from aftbed.vehicle.can.dbc_file import Codec
from aftbed.vehicle.can.e2e import P11, ChannelState, FrameStatus, Receiver, Supervision
from aftbed.vehicle.can.frame import Frame

LANE_HALF_M: Final = 1.5  # half a lane, less half of what a car may stick into it without being in our way
TIMEOUT_CYCLES: Final = 6
REPLICAS: Final = (1, 2)
TTC_MAX_S: Final = 40.95  # range of the signal
NOTICED_MAX: Final = 64
BLIND_PART: Final = 0.75  # of a radar cycle must have passed since the last request for a blind one


class GatewayCounts(msgspec.Struct):
    """Frames so far: accepted, not for us, and refused, by reason."""

    accepted: int = 0
    ignored: int = 0
    refused: dict[str, int] = msgspec.field(default_factory=dict)

    def refuse(self, reason: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1


class BusGateway(ABC):
    """The gateway as the client process has it: frames in, requests out, replies in, frames out.

    A subclass reads frames (`_request_of`); what it sends is the same for all: FTM_HEARTBEAT_n if one is due,
    then AEB_REQ. `replies_refused` are not replies to the brakes: the function refused the request, so there
    is nothing to ask for.
    """

    uses: tuple[int, ...] = ()  # identifiers of the frames that it evaluates, for the faults of the bus
    request_id: int | None = None  # of the frame that makes a request each time, where there is one

    def __init__(self, codec: Codec, encode: EncodeRequest = encode_request) -> None:
        """`codec` is aftbed's own DBC; `encode` writes the requests."""
        self.encode = encode
        self.counts = GatewayCounts()
        self.answered = 0
        self.replies_refused = 0
        self._codec = codec
        self._noticed: deque[Notice] = deque(maxlen=NOTICED_MAX)
        self._bus_us = 0  # of the latest frame
        self._aeb_req_id = codec.can_id("AEB_REQ")
        self._protection = P11(codec.data_id("AEB_REQ"))
        self._heartbeats = {replica: f"FTM_HEARTBEAT_{replica}" for replica in REPLICAS}
        self._heartbeat_cycle_us = codec.cycle_us(self._heartbeats[1])
        self._heartbeat_us: int | None = None

    @abstractmethod
    def _request_of(self, frame: Frame) -> bytes | None:
        """As `on_frame`."""

    def on_frame(self, frame: Frame) -> bytes | None:
        """Judge a frame off the bus: the payload of a request if it ends a radar cycle, else None."""
        self._bus_us = max(self._bus_us, frame.t_us)
        return self._request_of(frame)

    def noticed(self) -> list[Notice]:
        """What was found since the last call."""
        if not self._noticed:
            return []
        found = list(self._noticed)
        self._noticed.clear()
        return found

    def on_reply(self, reply: bytes, replica: int, epoch: int) -> list[Frame]:
        """The frames that the reply becomes; none, and counted, if it is not one to the brakes."""
        self.answered += 1
        try:
            return self.reply_frames(reply, self._bus_us, replica, epoch, self.answered)
        except PeerError:
            self.replies_refused += 1
            return []

    def reply_frames(self, reply: bytes, t_us: int, replica: int, epoch: int, answered: int) -> list[Frame]:
        """The frames that the reply becomes, sent at `t_us`. Raises PeerError if it is not a reply.

        The E2E counter is the reply's own, so a failover leaves no gap; the gateway counts where it has none.
        """
        assert replica in REPLICAS
        output = decode_reply(reply)
        signals = {
            "CRC": 0,
            "COUNTER": 0,
            "STAGE": output.stage,
            "TTC_VALID": int(output.ttc_s is not None),
            "DECELERATION": output.deceleration_ms2,
            "TARGET": output.slot or 0,
            "TTC": min(output.ttc_s or 0.0, TTC_MAX_S),
            "SEQUENCE": answered & 0xFFFF,
        }
        counter = answered % COUNTER_COUNT if output.counter is None else output.counter
        data = self._protection.protect(self._codec.encode("AEB_REQ", signals), counter)
        return [*self._heartbeat(t_us, replica, epoch, answered), Frame(t_us, self._aeb_req_id, data)]

    def _heartbeat(self, t_us: int, replica: int, epoch: int, answered: int) -> list[Frame]:
        if self._heartbeat_us is not None and t_us - self._heartbeat_us < self._heartbeat_cycle_us:
            return []
        self._heartbeat_us = t_us
        name = self._heartbeats[replica]
        signals = {"REPLICA": replica, "EPOCH": epoch & 0xFFFF, "ANSWERED": answered & 0xFFFF_FFFF}
        return [Frame(t_us, self._codec.can_id(name), self._codec.encode(name, signals))]


def target_of(slot: int, range_m: float, rel_speed_ms: float, new: bool) -> AebTarget | None:
    """A target, or None if the function would refuse it: no sensor means such a value."""
    if 0.0 <= range_m <= RANGE_MAX_M and -SPEED_MAX_MS <= rel_speed_ms <= SPEED_MAX_MS:
        return AebTarget(slot, range_m, rel_speed_ms, new)
    return None


class Gateway(BusGateway):
    """The gateway on aftbed's own bus: RADAR_TRACK, which makes the requests, and EGO_STATE in."""

    def __init__(self, codec: Codec, encode: EncodeRequest = encode_request) -> None:
        super().__init__(codec, encode)
        self._ego_id, self._ego = codec.can_id("EGO_STATE"), _receiver(codec, "EGO_STATE")
        self.request_id, self._track = codec.can_id("RADAR_TRACK"), _receiver(codec, "RADAR_TRACK")
        self.uses = (self._ego_id, self.request_id)
        self._objected: set[int] = set()  # identifiers of frames with which something was wrong
        self._t_us = 0
        self._ego_us = 0
        self._ego_speed_ms: float | None = None  # the last one accepted
        self._request_us: int | None = None  # when the last request was made
        self._blind_after_us = round(BLIND_PART * codec.cycle_us("RADAR_TRACK"))

    def _request_of(self, frame: Frame) -> bytes | None:
        if frame.can_id not in self.uses:
            self.counts.ignored += 1
            return None
        if frame.t_us < self._t_us:
            self.counts.refuse("time")
            return None
        if frame.can_id == self.request_id:
            return self._on_track(frame)
        if self._accepts(self._ego, frame):
            self.counts.accepted += 1
            self._use(frame)
            signals = self._codec.decode("EGO_STATE", frame.data)
            self._ego_speed_ms = signals["SPEED"] if signals["SPEED_VALID"] else None
            self._ego_us = frame.t_us
        return None

    def _on_track(self, frame: Frame) -> bytes | None:
        """The request that a RADAR_TRACK makes."""
        t_us, targets = frame.t_us, self._targets(frame)
        early = self._request_us is not None and t_us - self._request_us < self._blind_after_us
        if targets is None and early:
            return None
        self._request_us = t_us
        speed_ms = self._ego_speed_ms
        if speed_ms is None or t_us - self._ego_us > self._ego.supervision.timeout_us:
            self._object(Notice(self._ego_id, "timeout", t_us))
            speed_ms = None
        return self.encode(
            AebInput(t_us // 1000, speed_ms or 0.0, speed_ms is not None, targets is not None, targets or ())
        )

    def _targets(self, frame: Frame) -> tuple[AebTarget, ...] | None:
        """The targets in our path; None, and counted, if the frame is refused."""
        if not self._accepts(self._track, frame):
            return None
        signals = self._codec.decode("RADAR_TRACK", frame.data)
        slot, new = int(signals["TRACK_ID"]), bool(signals["NEW_TRACK"])
        target = target_of(slot, signals["RANGE"], signals["RELATIVE_SPEED"], new)
        if signals["VALID"] and target is None:
            self.counts.refuse("range")
            self._object(Notice(frame.can_id, "range", frame.t_us))
            return None
        self.counts.accepted += 1
        self._use(frame)
        in_path = signals["VALID"] and abs(signals["LATERAL_OFFSET"]) <= LANE_HALF_M
        return (target,) if target is not None and in_path else ()

    def _accepts(self, receiver: Receiver, frame: Frame) -> bool:
        """Whether the frame passes E2E; count it if it does not."""
        self._t_us = frame.t_us
        first = receiver.state is ChannelState.NODATA
        status = receiver.check(frame.data, frame.t_us)
        reason = receiver.refusal(frame.data, status)
        if reason is None:
            if status is FrameStatus.OK_SOMELOST:
                self._object(Notice(frame.can_id, "lost", frame.t_us))
            return True
        self.counts.refuse(reason)
        if not first or status is not FrameStatus.WRONGSEQUENCE:  # which is all that a first frame can be
            self._object(Notice(frame.can_id, reason, frame.t_us))
        return False

    def _object(self, notice: Notice) -> None:
        self._objected.add(notice.can_id)
        self._noticed.append(notice)

    def _use(self, frame: Frame) -> None:
        """The content of `frame` is used."""
        if frame.can_id in self._objected:
            self._objected.remove(frame.can_id)
            self._noticed.append(Notice(frame.can_id, GOOD_AGAIN, frame.t_us))


def _receiver(codec: Codec, name: str) -> Receiver:
    cycle_us = codec.cycle_us(name)
    profile, length = P11(codec.data_id(name)), codec.length(name)
    return Receiver(Supervision(profile, cycle_us, TIMEOUT_CYCLES * cycle_us, length))
