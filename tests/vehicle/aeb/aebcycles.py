"""Inputs of the protected function: any that there can be, and a few that make it brake."""

from hypothesis import strategies as st

from aftbed.vehicle.aeb.function import AebFunction
from aftbed.vehicle.aeb.messages import (
    SLOTS,
    STAGE_FULL,
    AebInput,
    AebOutput,
    AebTarget,
    decode_reply,
    encode_request,
)

EGO_MS = 14.0
NEAR = AebTarget(3, 14.0, -EGO_MS)  # a standing car, one second ahead

targets = st.builds(
    AebTarget,
    st.integers(0, SLOTS - 1),
    st.floats(0, 200),
    st.floats(-60, 60),
    st.booleans(),
)
cycles = st.builds(
    AebInput,
    st.integers(0, 100_000),
    st.floats(0, 70),
    st.booleans(),
    st.booleans(),
    st.lists(targets, max_size=SLOTS, unique_by=lambda target: target.slot).map(tuple),
)


def ask(
    function: AebFunction, t_ms: int, *seen: AebTarget, ego: bool = True, radar: bool = True
) -> AebOutput:
    cycle = AebInput(t_ms, EGO_MS, ego, radar, seen)
    return decode_reply(function.execute(encode_request(cycle)))


def braking() -> tuple[AebFunction, int]:
    """A function in full braking, and the time of its last request."""
    function = AebFunction()
    for t_ms in range(0, 1000, 20):
        if ask(function, t_ms, NEAR).stage == STAGE_FULL:
            return function, t_ms
    raise AssertionError("never in full braking")
