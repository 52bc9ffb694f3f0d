"""Supervision: a replica whose steps are skipped, doubled or late stops, and the other one takes its place.

After the Watchdog Manager of AUTOSAR: a supervised part reports where it begins and where it ends, and a
part that breaks one of three rules is not trusted any more. Here the part is what stands between Before and
After: Proceed, the Server, and all mechanisms inside. Before announces each request to After.

| supervision | rule | what breaks it |
|---|---|---|
| alive | what was announced ends | a step is skipped: a message is lost, a brick waits for ever |
| deadline | it ends within `DEADLINE_NS` | a slow replica, whose answers are right |
| logical | each request once, each reply to the request announced | a step is done twice, or out of order |

A Watchdog sees none of this: a brick that waits for a lost message is alive, and so is a slow one. A
violation ends the node, as a failed assertion does: a detected stop. Under a duplex the Watchdog then sees a
death, and Recovery fences the replica. No reply leaves that is out of order or late.

Only a leader that another replica can replace is held to that. Nothing waits for the reply of a follower,
and a late reply of a leader whose backup is lost is better than none. Their deadline is `LENIENT_NS`, and it
counts only while the host of After runs on time. So a machine that stands still, however long, does not end
both.

Limits: what happens outside of Before and After, as the checkpoint of an outer PBR, is not seen; a request
that comes from there twice is. A second execution is noticed by its reply, with the next request: the state
of the replica was wrong until then, and no other replica has it. A function, and the machine under it,
have to be faster than the deadline.
"""

from enum import auto
from typing import ClassVar, Final

from aftbed.core.brick import (
    ANY_STATE,
    CONTROL,
    DEADLINE_PASSED,
    NO_REQUEST,
    SAME_STATE,
    BrickAnswer,
    BrickState,
    Choice,
    DeadlinePassed,
    Effect,
    Halt,
    Machine,
    Moves,
    Note,
    Send,
    hand_on,
)
from aftbed.core.events import LATE, Event
from aftbed.core.messages import AnyMessage, Redundancy, Reply, Request, TakeOver
from aftbed.ftm.chain import COMPUTE, PassState
from aftbed.ftm.declaration import BrickKind, Emits, Mechanism, Suitability
from aftbed.ftm.failover import LATE_NS_MAX

DEADLINE_NS: Final = 25_000_000  # a cycle of the radar and a quarter; half of the HANG_DEADLINE_NS
LENIENT_NS: Final = 500_000_000

_EXIT: Final = Event.BEFORE_EXIT  # bound once: a look-up in an enumeration is slow on the hot path


def stop(request_id: int, reason: str, detail: int = 0) -> list[Effect]:
    return [Note(Event.DETECTED_STOP, request_id, detail), Halt(reason)]


class SupBefore(Machine):
    """Announces each request to After, then passes it on. `last_id`: the newest request so far."""

    AT_REST = (PassState.READY,)

    def __init__(self) -> None:
        super().__init__()
        self.last_id = NO_REQUEST

    def is_next(self, msg: Request) -> bool:
        return msg.request_id > self.last_id

    def announce(self, msg: Request) -> list[Effect]:
        """After knows of the request before there can be a reply."""
        self.last_id = msg.request_id
        return [Send("bfr2aft", msg), Note(_EXIT, msg.request_id), Send("bfr2prd", msg)]

    def stop_repeated(self, msg: Request) -> list[Effect]:
        """Nothing is executed twice."""
        return stop(msg.request_id, f"request {msg.request_id} came behind request {self.last_id}")

    MOVES: ClassVar[Moves] = {
        (PassState.READY, "pro2bfr", Request): Choice(
            is_next, {True: (announce, SAME_STATE), False: (stop_repeated, SAME_STATE)}
        ),
        (PassState.READY, "pro2bfr", TakeOver): (hand_on("bfr2prd"), SAME_STATE),  # behind the requests
    }


class SupAfterState(BrickState):
    IDLE = auto()  # nothing is inside
    AHEAD = auto()  # a reply was read before the announcement that must be there
    INSIDE = auto()  # a request is announced, and is to end


_S: Final = SupAfterState


class ReplyComes(BrickAnswer):
    IN_ORDER = auto()
    LATE = auto()
    OUT_OF_ORDER = auto()


_IN_ORDER: Final = ReplyComes.IN_ORDER


class SupAfter(Machine):
    """The supervision. `announced`: the request inside; `held`: the reply that came ahead.

    A new epoch shows that this replica has taken over, and that it is alone.
    """

    AT_REST = (_S.IDLE,)

    def __init__(self, epoch: int, leads: bool) -> None:
        super().__init__()
        self.epoch, self.announced = epoch, NO_REQUEST
        self.held: Reply | None = None
        self._strict = leads
        self._now_ns = 0
        self._began_ns: int | None = None  # what is inside, for the deadline

    def step(self, port: str, msg: AnyMessage | DeadlinePassed, now_ns: int) -> list[Effect]:
        """As every Machine; its handlers know the time."""
        self._now_ns = now_ns
        return super().step(port, msg, now_ns)

    def learn_redundancy(self, msg: Redundancy) -> list[Effect]:
        self.epoch, self._strict = max(self.epoch, msg.epoch), not msg.alone
        return []

    def expect(self, msg: Request) -> list[Effect]:
        """Its deadline runs from here on."""
        self.announced, self._began_ns = msg.request_id, self._now_ns
        if msg.epoch > self.epoch:
            self.epoch, self._strict = msg.epoch, False
        return []

    def how(self, msg: Reply) -> ReplyComes:
        if msg.request_id != self.announced:
            return ReplyComes.OUT_OF_ORDER
        due_ns = self.deadline_ns()
        late = self._strict and due_ns is not None and self._now_ns >= due_ns
        return ReplyComes.LATE if late else _IN_ORDER

    def release(self, msg: Reply) -> list[Effect]:
        self._began_ns = None
        return [Send("aft2pro", msg)]

    def hold(self, msg: Reply) -> list[Effect]:
        """Two channels: the announcement was sent first. Before a reply that comes twice, none was."""
        self.held, self._began_ns = msg, self._now_ns
        return []

    def is_of_held(self, msg: Request) -> bool:
        assert self.held is not None
        return msg.request_id == self.held.request_id

    def release_held(self, msg: Request) -> list[Effect]:
        held, self.held = self.held, None
        assert held is not None
        return self.release(held)

    def stop_at_held(self, msg: Request | DeadlinePassed) -> list[Effect]:
        assert self.held is not None
        self._began_ns = None
        number = self.held.request_id
        return stop(number, f"a reply to request {number}, which was not announced")

    def stop_out_of_order(self, msg: Reply) -> list[Effect]:
        return stop(self.announced, f"a reply to request {msg.request_id}, expected {self.announced}")

    def stop_late(self, msg: Reply | DeadlinePassed) -> list[Effect]:
        """No reply, or too late."""
        self._began_ns = None
        reason = f"request {self.announced} took more than {self._allowed_ns / 1e6:g} ms"
        return stop(self.announced, reason, LATE)

    @property
    def _allowed_ns(self) -> int:
        return DEADLINE_NS if self._strict else LENIENT_NS

    def deadline_ns(self) -> int | None:
        return None if self._began_ns is None else self._began_ns + self._allowed_ns

    def wake(self, now_ns: int) -> list[Effect]:
        due_ns = self.deadline_ns()
        assert due_ns is not None
        if not self._strict and now_ns - due_ns > LATE_NS_MAX:  # the machine stood still
            self._began_ns = now_ns
            return []
        return self.step(CONTROL, DEADLINE_PASSED, now_ns)

    MOVES: ClassVar[Moves] = {
        (ANY_STATE, CONTROL, Redundancy): (learn_redundancy, SAME_STATE),
        (_S.IDLE, "bfr2aft", Request): (expect, _S.INSIDE),
        (_S.IDLE, "prd2aft", Reply): (hold, _S.AHEAD),
        (_S.IDLE, "prd2aft", TakeOver): (hand_on("aft2pro"), SAME_STATE),
        (_S.AHEAD, "bfr2aft", Request): Choice(
            is_of_held, {True: (release_held, _S.IDLE), False: (stop_at_held, SAME_STATE)}
        ),
        (_S.AHEAD, CONTROL, DeadlinePassed): (stop_at_held, SAME_STATE),
        (_S.INSIDE, "prd2aft", Reply): Choice(
            how,
            {
                ReplyComes.IN_ORDER: (release, _S.IDLE),
                ReplyComes.LATE: (stop_late, SAME_STATE),
                ReplyComes.OUT_OF_ORDER: (stop_out_of_order, SAME_STATE),
            },
        ),
        (_S.INSIDE, CONTROL, DeadlinePassed): (stop_late, SAME_STATE),
    }


SUP: Final = Mechanism(
    name="sup",
    before=BrickKind(
        "sup.before",
        ("pro2bfr",),
        ("bfr2prd", "bfr2aft"),
        make=lambda setting: SupBefore(),
        events=(Emits(Event.BEFORE_EXIT),),
        visits=(Event.BEFORE_EXIT,),
        sends_beside=True,
    ),
    proceed=COMPUTE,
    after=BrickKind(
        "sup.after",
        ("bfr2aft", "prd2aft"),
        ("aft2pro",),
        # It emits `detected.stop` too; a fault is aimed at that of TR's After, since one kind stands for it.
        make=lambda setting: SupAfter(setting.epoch, setting.leads),
        told_redundancy=True,
    ),
    links=(("before", "bfr2aft", "after"),),
    suitability=Suitability(detects=("flow",), cpus=1, cpu_load="low", bandwidth="none"),
    combined=False,
    adaptations_explored=False,
)
