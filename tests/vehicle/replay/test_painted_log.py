"""The real drive with a car painted into it: the function brakes; without, never."""

import pytest
from paintedlog import SEEN_US, WHY_NOT, painted, real_drive
from puredrive import CODEC, TOYOTA_DBC, TOYOTA_LOG

from aftbed.vehicle.aeb.function import AebFunction
from aftbed.vehicle.aeb.messages import STAGE_FULL, STAGE_NONE, STAGE_WARN, AebOutput, decode_reply
from aftbed.vehicle.can.candump import LogFrame
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.replay.map_file import bind, find_map
from aftbed.vehicle.replay.mapped_gateway import MappedGateway

pytestmark = pytest.mark.skipif(not TOYOTA_LOG.is_file(), reason=WHY_NOT)

LANE_M = 3.6


def decisions(log: list[LogFrame]) -> list[AebOutput]:
    """What the function asks for over the log; each frame must be believed."""
    gateway, function = MappedGateway(CODEC, bind(find_map("toyota"), TOYOTA_DBC)), AebFunction()
    start_us = log[0].frame.t_us
    replies = []
    for entry in log:
        frame = entry.frame
        request = gateway.on_frame(Frame(frame.t_us - start_us, frame.can_id, frame.data))
        if request is not None:
            replies.append(decode_reply(function.execute(request)))
    assert gateway.counts.refused == {}
    assert gateway.counts.accepted == len(log)
    return replies


def test_without_paint_nothing_is_ever_asked_for() -> None:
    outputs = decisions(real_drive())
    assert len(outputs) == 200
    assert {(output.stage, output.deceleration_ms2) for output in outputs} == {(STAGE_NONE, 0.0)}


def test_a_car_that_stands_on_the_road_is_warned_of_and_braked_for() -> None:
    outputs = decisions(list(painted(real_drive())))
    stages = [output.stage for output in outputs]
    warned, full = stages.index(STAGE_WARN), stages.index(STAGE_FULL)
    assert set(stages[:warned]) == {STAGE_NONE}
    assert warned * 0.05 > SEEN_US / 1e6, "not before it was seen"
    assert (full - warned) * 0.05 >= 0.8
    assert outputs[full].deceleration_ms2 >= 5.0
    assert outputs[full].slot == 15
    ttc_s = outputs[full].ttc_s
    assert ttc_s is not None
    assert 1.0 < ttc_s < 2.0, "in time, and not too early"


def test_the_same_car_in_the_next_lane_is_none_of_our_business() -> None:
    outputs = decisions(list(painted(real_drive(), LANE_M)))
    assert {output.stage for output in outputs} == {STAGE_NONE}
