"""Any fault there is, for hypothesis to draw."""

from hypothesis import strategies as st

from aftbed.core.events import Event
from aftbed.core.units import DURATION_MS_MAX
from aftbed.inject.bus import Opening
from aftbed.inject.channel import HOLDING, ChannelFault, Disturbance
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import (
    BIT_MAX,
    BITS_MAX,
    ONCE,
    Bit,
    BitBurst,
    Bits,
    Byte,
    Chance,
    Every,
    Lasting,
    Permanent,
    StuckBit,
    Trigger,
)
from aftbed.inject.hang import FOREVER_MS, Hang
from aftbed.inject.memory import MemoryFlip
from aftbed.inject.model import Fault
from aftbed.inject.radar import (
    ANGLE_MAX_DEG,
    BIAS_MAX_M,
    DRIFT_MAX_MS,
    LATENCY_MS_MAX,
    RADAR,
    Bias,
    Drift,
    FieldOfView,
    Ghost,
    Latency,
    Missed,
    RadarFault,
)
from aftbed.inject.slow import SHARE_MAX, SHARE_MIN, SLOW_MS_MAX, Slow
from aftbed.inject.state import StateFlip
from aftbed.inject.value import ValueFlip, ValuePlace
from aftbed.vehicle.condition import QUANTITIES, Condition
from aftbed.vehicle.radar import RANGE_MAX_M, SPEED_MAX_MS

durations = st.integers(1, DURATION_MS_MAX)
after = st.builds(Trigger, after_ms=durations)
conditions = st.builds(
    Condition,
    st.sampled_from(QUANTITIES),
    st.booleans(),
    st.integers(-(10**9), 10**9).map(lambda millionths: millionths / 1e6),
)
triggers = st.one_of(
    st.just(Trigger()),
    st.builds(
        Trigger,
        st.sampled_from([e.label for e in Event]),
        st.integers(1, 10**9),
        when=st.none() | conditions,
    ),
    st.builds(Trigger, when=conditions),
    after,
)
bits = st.integers(0, BIT_MAX)
patterns = st.one_of(
    st.builds(Bit, st.none() | bits),
    st.builds(Bits, st.integers(1, BITS_MAX)),
    st.builds(Byte, st.none() | st.integers(0, BIT_MAX // 8)),
    st.builds(BitBurst, st.integers(1, BITS_MAX), st.none() | bits),
    st.builds(StuckBit, bits, st.integers(0, 1)),
)
persistences = st.one_of(
    st.just(ONCE),
    st.just(Permanent()),
    st.builds(Every, st.integers(1, 10**6)),
    st.builds(Chance, st.integers(1, 10**6).map(lambda millionths: millionths / 1e6)),
)
disturbances = st.one_of(
    st.builds(ChannelFault, st.sampled_from(HOLDING), st.sampled_from(("pxy2pro", "aft2aft")), durations),
    st.builds(
        ChannelFault, st.sampled_from([how for how in Disturbance if how not in HOLDING]), st.just("aft2pro")
    ),
)


def _millionths(least: float, most: float) -> st.SearchStrategy[float]:
    """With no more decimals than are written."""
    return st.integers(round(least * 1e6), round(most * 1e6)).map(lambda count: count / 1e6)


ranges = _millionths(1e-6, RANGE_MAX_M)
insufficiencies = st.one_of(
    st.just(Missed()),
    st.builds(Ghost, ranges, _millionths(-SPEED_MAX_MS, SPEED_MAX_MS)),
    st.builds(Bias, _millionths(1e-6, BIAS_MAX_M) | _millionths(-BIAS_MAX_M, -1e-6)),
    st.builds(Drift, _millionths(1e-6, DRIFT_MAX_MS) | _millionths(-DRIFT_MAX_MS, -1e-6)),
    st.builds(Latency, st.integers(1, LATENCY_MS_MAX)),
    st.builds(FieldOfView, ranges, _millionths(1e-6, ANGLE_MAX_DEG)),
)
openings = st.builds(Opening, st.just(0) | st.integers(1, 10**9)) | st.builds(Opening, when=conditions)
radar_faults = st.builds(
    RadarFault,
    insufficiencies,
    openings,
    persistences.filter(lambda found: found != ONCE) | st.builds(Lasting, st.integers(1, 10**9)),
)
fields = st.from_regex(r"[A-Za-z0-9_]{1,20}(\.[A-Za-z0-9_]{1,20})?", fullmatch=True)
replicas = st.sampled_from(("primary", "backup", "a", "b"))
faults = st.one_of(
    st.builds(Fault, st.just(Crash()), st.sampled_from(("primary", "b/after")), triggers),
    st.builds(Fault, st.builds(Hang, st.just(FOREVER_MS) | durations), st.just("backup"), triggers),
    st.builds(
        Fault,
        st.builds(Slow, st.integers(1, round(SLOW_MS_MAX)), st.just(0) | durations),
        st.just("a/server"),
        triggers,
    ),
    st.builds(
        Fault,
        disturbances,
        replicas,
        st.builds(Trigger, nth=st.integers(1, 10**9), when=st.none() | conditions) | after,
        persistences,
    ),
    st.builds(
        Fault,
        st.builds(
            Slow,
            st.just(0.0),
            st.just(0) | durations,
            st.integers(round(1e5 * SHARE_MIN), round(1e5 * SHARE_MAX)).map(lambda n: n / 1000 / 100),
        ),
        st.just("primary"),
        triggers,
    ),
    st.builds(
        Fault,
        st.builds(MemoryFlip, st.none() | st.integers(0, 7), st.none() | st.integers(0, 2**48 - 1)),
        st.sampled_from(("primary", "b/after")),
        triggers,
    ),
    st.builds(
        Fault, st.builds(ValueFlip, st.sampled_from(ValuePlace), patterns), replicas, triggers, persistences
    ),
    st.builds(Fault, st.builds(StateFlip, fields, patterns), replicas, triggers),
    st.builds(Fault, radar_faults, st.just(RADAR)),
)
