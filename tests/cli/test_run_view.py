"""What a run prints where there is no terminal."""

import pytest

from aftbed.cli.views import PlainView
from aftbed.runtime.unix.options import CarRun, LoadRun, RunOptions, Work
from aftbed.vehicle.aeb.messages import AebInput, AebTarget, sight_of

DRIVE = CarRun("ccrs-50", 1.0, "latch")
BUS = "bus: can0 at 127.0.0.1:29536, for clients of socketcand"


def options(work: Work, port: int) -> RunOptions:
    return RunOptions("3f09c1", "/gone", "/gone/record", "pbr", "process", 0, work, port=port)


def test_it_prints_where_the_bus_is(capsys: pytest.CaptureFixture[str]) -> None:
    PlainView(options(DRIVE, 29536))
    assert capsys.readouterr().out.splitlines()[1] == BUS


def test_a_run_without_a_bus_shows_none(capsys: pytest.CaptureFixture[str]) -> None:
    PlainView(options(LoadRun(10, 0.0), 0))
    assert "bus" not in capsys.readouterr().out


def test_a_replay_prints_what_the_function_sees(capsys: pytest.CaptureFixture[str]) -> None:
    view = PlainView(options(DRIVE, 0))
    for t_ms in range(1500, 2000, 50):
        view.sight(sight_of(AebInput(t_ms, 20.0, True, True, (AebTarget(0, 34.0, -10.0),)), 3, 6.0))
    lines = capsys.readouterr().out.splitlines()
    assert lines[1:] == ["  1.50 s   72.0 km/h  gap  34.00 m  TTC  3.40 s  FULL     asks for 6.0 m/s2"]
