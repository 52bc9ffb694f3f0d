"""The executable assertion of the protected function: what it lets through, and what it finds."""

from collections import Counter
from collections.abc import Iterator
from random import Random

import msgspec
import pytest
from aebcycles import EGO_MS, braking, cycles
from hypothesis import given, settings
from hypothesis import strategies as st

from aftbed.inject.grammar import with_flipped
from aftbed.vehicle.aeb.function import DEMAND_MS2, AebFunction, sample_requests
from aftbed.vehicle.aeb.messages import (
    STAGE_FULL,
    STAGE_NONE,
    STAGE_PARTIAL,
    STAGE_WARN,
    AebInput,
    AebOutput,
    AebTarget,
    decode_reply,
    decode_request,
    encode_reply,
    encode_request,
)


def rough(seed: int, count: int) -> Iterator[AebInput]:
    """A sample drive with all that can come between: blindness, lost and strange targets, gaps in time."""
    random, late_ms = Random(seed), 0
    for request in sample_requests(seed, count):
        cycle = decode_request(request)
        if random.random() < 0.02:
            late_ms += random.choice((1, 200, 600))
        yield AebInput(
            cycle.t_ms + late_ms,
            cycle.ego_speed_ms * (random.random() > 0.01),
            random.random() > 0.05,
            random.random() > 0.05,
            tuple(strange(random, target) for target in cycle.targets if random.random() > 0.1),
        )


def strange(random: Random, target: AebTarget) -> AebTarget:
    """`target`, at times with a noise of up to beyond what a track takes for the same one."""
    size = random.choice((0.0, 0.0, 1.0, 5.0))
    return AebTarget(
        target.slot,
        max(0.0, target.range_m + random.uniform(-1.1, 1.1) * size),
        target.rel_speed_ms + random.uniform(-1.1, 1.1) * size,
        random.random() < 0.02,
    )


@given(st.integers(0, 2**32))
@settings(max_examples=3 * settings.default.max_examples)
def test_every_reply_of_the_function_is_acceptable_in_a_rough_drive(seed: int) -> None:
    function = AebFunction()
    for cycle in rough(seed, 300):
        request = encode_request(cycle)
        assert function.acceptable(request, function.execute(request))


@given(st.lists(cycles, max_size=12), st.booleans())
def test_every_reply_of_the_function_is_acceptable_whatever_is_asked(
    asked: list[AebInput], in_order: bool
) -> None:
    function = AebFunction()
    for n, cycle in enumerate(asked):
        at = msgspec.structs.replace(cycle, t_ms=20 * n) if in_order else cycle
        request = encode_request(at)
        assert function.acceptable(request, function.execute(request))


def test_a_rough_drive_shows_every_stage_and_coasting_threats() -> None:
    """The tests above are worth as much as what happens in them."""
    seen: Counter[str] = Counter()
    for seed in range(10):
        function = AebFunction()
        for cycle in rough(seed, 300):
            output = decode_reply(function.execute(encode_request(cycle)))
            measured = cycle.ego_valid and cycle.radar_valid
            seen[f"stage {output.stage}"] += 1
            seen["no ttc"] += output.slot is not None and output.ttc_s is None
            seen["blind"] += output.slot is not None and not measured
            slots = {target.slot for target in cycle.targets}
            seen["coasting"] += measured and output.slot is not None and output.slot not in slots
    wanted = {"stage 0", "stage 1", "stage 2", "stage 3", "no ttc", "blind", "coasting"}
    assert {what for what, count in seen.items() if count > 5} >= wanted, seen


def test_flipped_bits_are_noticed_as_often_as_is_said_and_always_in_the_demand() -> None:
    noticed = {threat: Counter[bool]() for threat in (False, True)}
    for seed in range(5):
        function = AebFunction()
        for request in sample_requests(seed, 1500)[::21]:
            reply = function.execute(request)
            output = decode_reply(reply)
            for bit in range(8 * len(reply)):
                found = not function.acceptable(request, with_flipped(reply, [bit]))
                noticed[output.slot is not None][found] += 1
                if not found:
                    changed = decode_reply(with_flipped(reply, [bit]))
                    assert changed.deceleration_ms2 == output.deceleration_ms2
    shares = {threat: round(100 * n[True] / n.total()) for threat, n in noticed.items()}
    said = AebFunction.acceptable.__doc__
    assert said is not None and f"{shares[False]} % flipped where there is no threat" in said, shares
    assert f"{shares[True]} % where" in said, shares


NEARING = AebInput(1000, EGO_MS, True, True, (AebTarget(3, 28.0, -EGO_MS),))  # 2 s ahead


def answering(**fields: object) -> bytes:
    """A sound reply to NEARING, with some fields replaced."""
    sound = AebOutput(STAGE_PARTIAL, DEMAND_MS2[STAGE_PARTIAL], 2.0, 3, 7)
    return encode_reply(msgspec.structs.replace(sound, **fields))


@pytest.mark.parametrize(
    ("reply", "acceptable"),
    [
        (answering(), True),
        (answering(counter=8), True),
        (answering(stage=STAGE_WARN, deceleration_ms2=0.0), True),
        (answering(slot=4, ttc_s=0.1), True),  # a track that is coasting
        (answering(slot=None, ttc_s=None), True),  # the stage is held
        (b"", False),
        (answering() + b"\0", False),
        (answering(stage=4), False),
        (answering(stage=STAGE_FULL), False),
        (answering(deceleration_ms2=9.0), False),
        (answering(deceleration_ms2=-0.0, stage=STAGE_WARN), False),
        (answering(stage=STAGE_NONE, deceleration_ms2=0.0), False),  # at 2 s, with a stage of NONE
        (answering(slot=None), False),
        (answering(ttc_s=None), False),  # it closes at 14 m/s
        (answering(ttc_s=(28.0 - 2.5) / (14.0 + 3.5) + 0.001), True),
        (answering(ttc_s=(28.0 - 2.5) / (14.0 + 3.5) - 0.001), False),
        (answering(ttc_s=(28.0 + 2.5) / (14.0 - 3.5) - 0.001), True),
        (answering(ttc_s=(28.0 + 2.5) / (14.0 - 3.5) + 0.001), False),
    ],
)
def test_what_is_acceptable(reply: bytes, acceptable: bool) -> None:
    assert AebFunction().acceptable(encode_request(NEARING), reply) == acceptable


@pytest.mark.parametrize(
    ("fields", "reply", "acceptable"),
    [
        (
            {"radar_valid": False},
            answering(stage=STAGE_NONE, deceleration_ms2=0.0),
            True,
        ),  # it decides nothing
        ({"ego_valid": False}, answering(ttc_s=9.0), True),
        ({"ego_speed_ms": 0.0}, answering(stage=STAGE_NONE, deceleration_ms2=0.0), True),
        ({"targets": (AebTarget(3, 28.0, -EGO_MS, True),)}, answering(), False),  # not confirmed by now
        ({"targets": (AebTarget(3, 28.0, 3.4),)}, answering(ttc_s=999.0), True),
        ({"targets": (AebTarget(3, 28.0, 3.6),)}, answering(ttc_s=999.0), False),  # it moves away
        ({"targets": (AebTarget(3, 28.0, 3.6),)}, answering(ttc_s=None), True),
        ({"t_ms": -1}, answering(), False),  # such a request has one answer
        ({"t_ms": -1}, b"", True),
    ],
)
def test_what_is_acceptable_depends_on_the_request(
    fields: dict[str, object], reply: bytes, acceptable: bool
) -> None:
    request = encode_request(msgspec.structs.replace(NEARING, **fields))
    assert AebFunction().acceptable(request, reply) == acceptable


def test_to_judge_a_reply_changes_nothing() -> None:
    function, _ = braking()
    before = function.capture()
    assert function.acceptable(encode_request(NEARING), answering())
    assert not function.acceptable(encode_request(NEARING), answering(stage=4))
    assert function.capture() == before
