"""Server: the protected function behind four messages: execute, try, capture, restore (paper, III-A).

State access is the A of FT/A/R that some mechanisms need. The Server knows neither the function (bytes in,
bytes out) nor the mechanism: it learns what will be asked of it from which of its outputs are bound. So a
switch to another mechanism never exchanges it. Of a large state only what changed goes to an After (`pages`).

| `srv2aft` bound | `srv2bfr` bound | what is asked of it                                        |
|-----------------|-----------------|------------------------------------------------------------|
| no              | no              | requests                                                   |
| to an After     | no              | a request, then the state after it                         |
| no              | to a Before     | the state before a request, then trials of it              |
| to an After     | to a Before     | the state before, trials, the state after                  |

Each of the four is a table of its own. Nearly always one port is open, in which a host can block; waiting for
two costs it a poll. After a rerun two are open, since nothing shows here whether a vote takes another trial.
"""

from enum import auto
from typing import ClassVar, Final

from aftbed.core.application import Application
from aftbed.core.brick import (
    ANY_STATE,
    CONTROL,
    SAME_STATE,
    BrickAnswer,
    BrickState,
    Choice,
    Effect,
    Halt,
    Machine,
    Moves,
    Note,
    Send,
    ignore,
)
from aftbed.core.errors import PeerError
from aftbed.core.events import RERUN, Event
from aftbed.core.messages import (
    CaptureState,
    Rebound,
    Reply,
    Request,
    RestoreState,
    StateCaptured,
    StateRestored,
    Trial,
    Tried,
)
from aftbed.ftm.declaration import BrickKind, Emits
from aftbed.ftm.pages import PAGE_BYTES, CheckpointBase


class ServerState(BrickState):
    STANDBY = auto()  # a backup's or a leader's: the first request decides
    READY = auto()  # for a request
    TRYING = auto()  # Before has the state, trials follow, up to a rerun
    EXECUTED = auto()  # After will ask for the state after it


class TrialRun(BrickAnswer):
    FIRST = auto()
    RERUN = auto()


class BoundOutput(BrickAnswer):
    STATE_AFTER = auto()  # srv2aft
    STATE_BEFORE = auto()  # srv2bfr
    OTHER = auto()


STATE_AFTER, STATE_BEFORE, STATE_BEFORE_AND_AFTER = "state after", "state before", "state before and after"
_TABLES: Final = {  # srv2aft bound, srv2bfr bound
    (False, False): "",
    (True, False): STATE_AFTER,
    (False, True): STATE_BEFORE,
    (True, True): STATE_BEFORE_AND_AFTER,
}

_S: Final = ServerState
_OUTPUTS: Final = {"srv2aft": BoundOutput.STATE_AFTER, "srv2bfr": BoundOutput.STATE_BEFORE}

# Bound once: a look-up in an enumeration is slow on the hot path.
_FIRST, _RERUN = TrialRun.FIRST, TrialRun.RERUN
_ENTER: Final = Event.SERVER_ENTER
_EXIT: Final = Event.SERVER_EXIT
_CAPTURED: Final = Event.STATE_CAPTURED
_RESTORED: Final = Event.STATE_RESTORED


class Server(Machine):
    """`replica` (1 or 2) marks the replies as its own; `page_bytes`: of a page of a checkpoint."""

    AT_REST = (_S.STANDBY, _S.READY)

    def __init__(self, application: Application, replica: int, page_bytes: int = PAGE_BYTES) -> None:
        super().__init__()
        self.application, self.replica = application, replica
        self._base = CheckpointBase(page_bytes)
        self._state_after = self._state_before = False  # whether the outputs for it are bound

    def execute(self, msg: Request) -> list[Effect]:
        payload = self._execute(msg.payload)
        return [
            Note(_ENTER, msg.request_id),
            Note(_EXIT, msg.request_id),
            Send("srv2prd", Reply(msg.epoch, msg.request_id, self.replica, payload)),
        ]

    def which_run(self, msg: Trial) -> TrialRun:
        return _RERUN if msg.rerun else _FIRST

    def try_first(self, msg: Trial) -> list[Effect]:
        """Execute from the present state."""
        return self._try(msg, 0)

    def try_again(self, msg: Trial) -> list[Effect]:
        """Execute from the state that the first trial started from."""
        self.application.restore(msg.state)
        return self._try(msg, RERUN)

    def capture_after(self, msg: CaptureState) -> list[Effect]:
        """After asks for the state after exactly this request: a checkpoint."""
        state = self._base.capture(self.application, msg.request_id, msg.base)
        captured = StateCaptured(msg.epoch, msg.request_id, state)
        return [Note(_CAPTURED, msg.request_id), Send("srv2aft", captured)]

    def capture_before(self, msg: CaptureState) -> list[Effect]:
        """Before asks for the state before this request: the trials start from it."""
        captured = StateCaptured(msg.epoch, msg.request_id, self.application.capture())
        return [Note(_CAPTURED, msg.request_id), Send("srv2bfr", captured)]

    def restore_state(self, msg: RestoreState) -> list[Effect]:
        """Take over the state of a checkpoint. A backup that cannot is dropped, and a new one is made."""
        try:
            self._base.restore(self.application, msg.request_id, msg.state)
        except PeerError as error:
            reason = f"the state after request {msg.request_id} is refused: {error}"
            return [Note(Event.DETECTED_STOP, msg.request_id), Halt(reason)]
        return [
            Note(_RESTORED, msg.request_id),
            Send("srv2aft", StateRestored(msg.epoch, msg.request_id)),
        ]

    def which_output(self, msg: Rebound) -> BoundOutput:
        """Which of the four tables may be the next one depends on it."""
        return _OUTPUTS.get(msg.port, BoundOutput.OTHER)

    def rebind_after(self, msg: Rebound) -> list[Effect]:
        """With another After this replica may back up from now on, or lead: the next checkpoint is whole."""
        self._base.forget()
        self._state_after = msg.bound
        return self._go_by_bindings()

    def rebind_before(self, msg: Rebound) -> list[Effect]:
        """Trials will come, or requests."""
        self._state_before = msg.bound
        return self._go_by_bindings()

    def _go_by_bindings(self) -> list[Effect]:
        self.go_by(_TABLES[self._state_after, self._state_before])
        return []

    def _execute(self, request: bytes) -> bytes:
        """The reply; an empty one to a request that the function refuses (its state is as it was)."""
        try:
            return self.application.execute(request)
        except PeerError:
            return b""

    def _try(self, msg: Trial, detail: int) -> list[Effect]:
        payload = self._execute(msg.payload)
        tried = Tried(msg.epoch, msg.request_id, self.replica, payload, self.application.capture())
        return [
            Note(_ENTER, msg.request_id, detail),
            Note(_EXIT, msg.request_id, detail),
            Send("srv2prd", tried),
        ]

    def capture(self) -> bytes:
        return self.application.capture()

    def restore(self, state: bytes) -> None:
        self.application.restore(state)
        self._base.replaced()

    def migrate(self, state: bytes) -> None:
        """Take over the state of another function, which has been this one's until now."""
        migrate = getattr(self.application, "migrate", self.application.restore)
        migrate(state)
        self._base.replaced()

    # -- the tables ---------------------------------------------------------------------------

    _REBOUND: ClassVar[Moves] = {
        (ANY_STATE, CONTROL, Rebound): Choice(
            which_output,
            {
                BoundOutput.STATE_AFTER: (rebind_after, _S.STANDBY),
                BoundOutput.STATE_BEFORE: (rebind_before, SAME_STATE),
                BoundOutput.OTHER: (ignore, SAME_STATE),
            },
        ),
        (_S.TRYING, CONTROL, Rebound): Choice(
            which_output,
            {
                BoundOutput.STATE_AFTER: (rebind_after, _S.STANDBY),
                BoundOutput.STATE_BEFORE: (rebind_before, _S.STANDBY),  # that Before's trials will not come
                BoundOutput.OTHER: (ignore, SAME_STATE),
            },
        ),
    }
    _TRIAL_THEN_READY: ClassVar[Choice] = Choice(
        which_run, {TrialRun.FIRST: (try_first, _S.TRYING), TrialRun.RERUN: (try_again, _S.READY)}
    )
    _TRIAL_THEN_EXECUTED: ClassVar[Choice] = Choice(
        which_run, {TrialRun.FIRST: (try_first, _S.TRYING), TrialRun.RERUN: (try_again, _S.EXECUTED)}
    )

    MOVES: ClassVar[Moves] = {  # nothing is asked for beside requests
        (_S.STANDBY, "prd2srv", Request): (execute, _S.READY),
        (_S.READY, "prd2srv", Request): (execute, SAME_STATE),
        **_REBOUND,
    }
    MOVES_STATE_AFTER: ClassVar[Moves] = {
        (_S.STANDBY, "aft2srv", RestoreState): (restore_state, SAME_STATE),
        (_S.STANDBY, "prd2srv", Request): (execute, _S.EXECUTED),
        (_S.READY, "prd2srv", Request): (execute, _S.EXECUTED),
        (_S.EXECUTED, "aft2srv", CaptureState): (capture_after, _S.READY),
        **_REBOUND,
    }
    MOVES_STATE_BEFORE: ClassVar[Moves] = {
        (_S.STANDBY, "bfr2srv", CaptureState): (capture_before, _S.TRYING),
        (_S.STANDBY, "prd2srv", Trial): _TRIAL_THEN_READY,
        (_S.READY, "bfr2srv", CaptureState): (capture_before, _S.TRYING),  # the next request ...
        (_S.READY, "prd2srv", Trial): _TRIAL_THEN_READY,  # ... or a third trial
        (_S.TRYING, "prd2srv", Trial): _TRIAL_THEN_READY,
        **_REBOUND,
    }
    MOVES_BOTH: ClassVar[Moves] = {
        (_S.STANDBY, "aft2srv", RestoreState): (restore_state, SAME_STATE),
        (_S.STANDBY, "bfr2srv", CaptureState): (capture_before, _S.TRYING),
        (_S.STANDBY, "prd2srv", Trial): _TRIAL_THEN_EXECUTED,
        (_S.READY, "bfr2srv", CaptureState): (capture_before, _S.TRYING),
        (_S.TRYING, "prd2srv", Trial): _TRIAL_THEN_EXECUTED,
        (_S.EXECUTED, "aft2srv", CaptureState): (capture_after, _S.READY),  # the end of the request ...
        (_S.EXECUTED, "prd2srv", Trial): Choice(
            which_run, {TrialRun.RERUN: (try_again, SAME_STATE)}
        ),  # ... or a third trial
        **_REBOUND,
    }
    FURTHER_MOVES: ClassVar[dict[str, Moves]] = {
        STATE_AFTER: MOVES_STATE_AFTER,
        STATE_BEFORE: MOVES_STATE_BEFORE,
        STATE_BEFORE_AND_AFTER: MOVES_BOTH,
    }


SERVER: Final = BrickKind(
    "server",
    ("prd2srv", "aft2srv", "bfr2srv"),
    ("srv2prd", "srv2aft", "srv2bfr"),
    ("aft2srv", "bfr2srv", "srv2aft", "srv2bfr"),
    make=lambda setting: Server(setting.application(), setting.replica, setting.page_bytes),
    events=(Emits(Event.SERVER_ENTER), Emits(Event.SERVER_EXIT)),
)
BARE_SERVER: Final = BrickKind(  # without a mechanism
    "bare.server",
    ("prd2srv",),
    ("srv2prd",),
    make=lambda setting: Server(setting.application(), setting.replica, setting.page_bytes),
    events=(Emits(Event.SERVER_ENTER), Emits(Event.SERVER_EXIT)),
)
