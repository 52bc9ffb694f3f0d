"""Generated logs with every kind of frame."""

from typing import Final

from hypothesis import strategies as st

from aftbed.interop.logs import (
    EXTENDED_ID_MAX,
    FD_LENGTHS,
    TIME_US_MAX,
    FdFlags,
    FrameKind,
    LoggedFrame,
)
from aftbed.vehicle.can.frame import CAN_ID_MAX

NOW_US: Final = 1_790_000_000_000_000
TIMES_US: Final = st.one_of(
    st.integers(0, 60_000_000),  # since the start of a log
    st.integers(NOW_US, NOW_US + 3_600_000_000),
    st.integers(0, TIME_US_MAX),
)
INTERFACES: Final = st.sampled_from(("can0", "can1", "can7"))


@st.composite
def frames(draw: st.DrawFn) -> LoggedFrame:
    """Any one."""
    kind = draw(st.sampled_from(FrameKind))
    extended = kind is FrameKind.ERROR or draw(st.booleans())
    data = b"" if kind is FrameKind.REMOTE else draw(st.binary(max_size=8))
    fd = None
    if kind is FrameKind.DATA and draw(st.booleans()):
        fd = FdFlags(draw(st.booleans()), draw(st.booleans()))
        length = draw(st.sampled_from(FD_LENGTHS))
        data = draw(st.binary(min_size=length, max_size=length))
    return LoggedFrame(
        t_us=draw(TIMES_US),
        interface=draw(INTERFACES),
        can_id=draw(st.integers(0, EXTENDED_ID_MAX if extended else CAN_ID_MAX)),
        data=data,
        extended=extended,
        kind=kind,
        length=draw(st.integers(0, 8)) if kind is FrameKind.REMOTE else 0,
        sent=kind is not FrameKind.ERROR and draw(st.booleans()),
        fd=fd,
    )


LOGS: Final = st.lists(frames(), min_size=1, max_size=12).map(tuple)
