"""What the views of a live run show before anything happens."""

import pytest
from rich.console import Console

from aftbed.cli.views import LiveView, PlainView
from aftbed.runtime.unix.options import CarRun, LoadRun, RunOptions, Work

DRIVE = CarRun("ccrs-50", 1.0, "latch")
BUS = "bus: can0 at 127.0.0.1:29536, for clients of socketcand"


def options(work: Work, port: int) -> RunOptions:
    return RunOptions("3f09c1", "/gone", "/gone/record", "pbr", "process", 0, work, port=port)


def live(shown: RunOptions) -> str:
    console = Console(width=100)
    with console.capture() as printed:
        console.print(LiveView(shown).render())
    return printed.get()


def test_both_views_show_where_the_bus_is(capsys: pytest.CaptureFixture[str]) -> None:
    PlainView(options(DRIVE, 29536))
    assert capsys.readouterr().out.splitlines()[1] == BUS
    assert BUS in live(options(DRIVE, 29536))


def test_a_run_without_a_bus_shows_none(capsys: pytest.CaptureFixture[str]) -> None:
    PlainView(options(LoadRun(10, 0.0), 0))
    assert "bus" not in capsys.readouterr().out + live(options(LoadRun(10, 0.0), 0))
