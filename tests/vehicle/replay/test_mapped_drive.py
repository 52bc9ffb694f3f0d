"""Maps by name; and a real drive through one: every frame is accepted, and the function never even warns."""

from pathlib import Path

import pytest
import yaml
from buslog import read_log
from puredrive import CODEC, TOYOTA_DBC, TOYOTA_LOG

from aftbed.core.errors import ConfigError
from aftbed.vehicle.aeb.function import AebFunction
from aftbed.vehicle.aeb.messages import decode_reply, decode_request
from aftbed.vehicle.can.dbc_file import load_dbc
from aftbed.vehicle.can.frame import Frame
from aftbed.vehicle.replay.map_file import Messages, bind, find_map
from aftbed.vehicle.replay.map_proposal import propose
from aftbed.vehicle.replay.map_trial import try_out
from aftbed.vehicle.replay.mapped_gateway import MappedGateway


@pytest.mark.parametrize(
    ("name", "names"),
    [
        ("T{n}", ["T8", "T9", "T10"]),
        ("T{n:02}", ["T08", "T09", "T10"]),
        ("{n:03}T{n}", ["008T8", "009T9", "010T10"]),
        ("T{n:x}", ["T8", "T9", "Ta"]),
        ("T{n:03X}", ["T008", "T009", "T00A"]),
        ("T{n:2}", ["T{n:2}"] * 3),
    ],
)
def test_names_with_numbers(name: str, names: list[str]) -> None:
    assert Messages(name, 8, 10).names() == names


def test_numbers_may_be_large_and_go_in_steps() -> None:
    assert Messages("M_{n:X}hex", 0x319, 0x320, 3).names() == ["M_319hex", "M_31Chex", "M_31Fhex"]


def test_an_unknown_map_comes_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match="unknown map 'toyotta'; did you mean 'toyota'"):
        find_map("toyotta")
    assert find_map("./my.yaml") == Path("./my.yaml")


def test_the_shipped_map_is_found_and_described() -> None:
    assert yaml.safe_load(find_map("toyota").read_text())["cycle_end"] == "TRACK_B_15"


@pytest.mark.skipif(not TOYOTA_LOG.is_file(), reason="the real drive is not here")
class TestRealDrive:
    def frames(self) -> list[Frame]:
        log, _ = read_log(TOYOTA_LOG)
        start_us = log[0].frame.t_us
        return [Frame(entry.frame.t_us - start_us, entry.frame.can_id, entry.frame.data) for entry in log]

    def test_all_frames_are_accepted_and_the_function_never_even_warns(self) -> None:
        gateway, function = MappedGateway(CODEC, bind(find_map("toyota"), TOYOTA_DBC)), AebFunction()
        requests = [made for frame in self.frames() if (made := gateway.on_frame(frame)) is not None]
        assert (gateway.counts.accepted, gateway.counts.refused) == (6920, {})
        assert len(requests) == 200
        cycles = [decode_request(request) for request in requests]
        assert all(cycle.ego_valid and cycle.radar_valid and cycle.targets for cycle in cycles)
        assert min(cycle.ego_speed_ms for cycle in cycles) * 3.6 > 49
        nearest_m = min(target.range_m for cycle in cycles for target in cycle.targets)
        assert 25.0 < nearest_m < 30.0
        assert {decode_reply(function.execute(request)).stage for request in requests} == {0}

    def test_what_is_proposed_from_it_decodes_what_the_shipped_map_does(self, tmp_path: Path) -> None:
        (tmp_path / "car.dbc").write_text(
            'BU_: X\nBO_ 180 SPEED: 8 X\n SG_ SPEED : 47|16@0+ (0.01,0) [0|250] "km/h" X\n'
        )
        codecs = [load_dbc(path, strict=False) for path in (TOYOTA_DBC, tmp_path / "car.dbc")]
        proposal = propose(codecs, self.frames())
        assert (proposal.bound is not None, proposal.problems) == (True, ())
        assert proposal.bound is not None
        found = try_out(proposal.bound, self.frames())
        by_hand = try_out(bind(find_map("toyota"), TOYOTA_DBC), self.frames())
        assert (found.refused, found.problems()) == ({}, [])
        assert (found.cycles, found.with_ego, found.with_targets) == (200, 200, 200)
        assert (found.targets, found.range_m, found.ego_kmh, found.shown) == (
            by_hand.targets,
            by_hand.range_m,
            by_hand.ego_kmh,
            by_hand.shown,
        )

    def test_damaged_frames_are_refused_one_by_one_and_nothing_else_is(self) -> None:
        gateway = MappedGateway(CODEC, bind(find_map("toyota"), TOYOTA_DBC))
        damaged = 0
        for number, frame in enumerate(self.frames()):
            flip = 0x40 if number % 10 == 3 else 0
            damaged += flip > 0
            gateway.on_frame(Frame(frame.t_us, frame.can_id, bytes([frame.data[0] ^ flip]) + frame.data[1:]))
        assert gateway.counts.refused == {"checksum": damaged}
