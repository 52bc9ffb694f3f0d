"""`aftbed bench paper`: one document of figures that were measured, and a page of it.

No test depends on speed: it must hold on a busy machine.
"""

from functools import partial
from pathlib import Path
from typing import Final

import msgspec
import pytest
from liveruns import Home, forked

from aftbed.bench import resources, sweep
from aftbed.bench.paper import CYCLES, QUICK, Paper, tables
from aftbed.bench.runs import tried
from aftbed.core.errors import HarnessError
from aftbed.core.graph import PLACEMENTS

HOUR_NS: Final = 3_600_000_000_000
QUICK_SECONDS_MAX: Final = 240.0  # of half a minute on a machine with nothing else to do
TAKEN: Final = {  # names of figures: what the paper has, and what stands beside it
    "initialisation.graph",
    "initialisation.reply",
    *(f"cycle.{ftm}" for ftm in CYCLES),
    *(f"recovery.{ftm}{part}" for ftm in ("pbr", "lfr") for part in ("", ".after_detection")),
    *(f"adapt.{way}.{part}" for way in ("compose", "switch", "update") for part in ("blackout", "total")),
}

pytestmark = pytest.mark.process


def check(paper: Paper) -> None:
    """Every figure is there, and is one."""
    found = {figure.name: figure for figure in paper.figures}
    assert TAKEN <= set(found) <= TAKEN | {"adapt.recipe.blackout", "adapt.recipe.total"}
    for figure in paper.figures:
        ours = figure.ours_ms
        assert 0 < ours.p50 <= ours.p95 <= ours.p99 <= ours.max and figure.ring_us > 0 and figure.samples > 0
    for ftm in ("pbr", "lfr"):
        assert found[f"recovery.{ftm}"].ours_ms.max > found[f"recovery.{ftm}.after_detection"].ours_ms.max
    for way in ("compose", "switch", "update"):
        assert found[f"adapt.{way}.blackout"].ours_ms.p50 < found[f"adapt.{way}.total"].ours_ms.p50
    counts = {(count.ftm, count.placement): (count.ours, count.paper) for count in paper.processes}
    assert counts["pbr", "process"] == (17, 17) and counts["pbr+tr", "process"] == (23, 23)
    assert [placed.placement for placed in paper.placements] == list(PLACEMENTS)
    assert [placed.survives_crash for placed in paper.placements] == [True, True, False]
    for placed in paper.placements:
        assert placed.idle.cpu_percent > 0 and placed.loaded.cpu_percent > 0 and placed.loaded.pss_mb > 1
    assert [(row.ftm, row.state_bytes) for row in paper.state] == [
        (ftm, size) for ftm in ("pbr", "lfr") for size in QUICK.sizes_bytes
    ]
    assert all(row.cycle_us is not None and not row.refused for row in paper.state)
    assert len(paper.load) == 2 * len(QUICK.rates_hz)


@pytest.mark.deep  # each of its parts is measured below, and its page made of figures in `test_paper_page`
@pytest.mark.timeout(2 * QUICK_SECONDS_MAX)
def test_it_measures_every_figure_and_writes_the_page(home: Home, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    done = forked("bench", "paper", "--quick", "--json", "--html", page, seconds=QUICK_SECONDS_MAX)
    assert done.code == 0, done.err
    paper = msgspec.json.decode(done.out, type=Paper)
    assert paper.quick
    check(paper)
    assert page.read_text().count("<table>") == len(tables(paper))


def test_a_load_is_measured_in_its_window(home: Home) -> None:
    """A machine that lags sends fewer requests than was asked for, and `sent_hz` says so."""
    measure = partial(resources.under_load, "pbr", "replica", 100.0, 0.5)
    found = tried("a load", measure, print)  # as the bench does
    assert 0 < found.requests <= 100 and found.usage.processes == 9
    assert found.sent_hz == pytest.approx(found.requests / found.usage.seconds, abs=0.1)
    assert found.usage.seconds >= 0.5 and 0 < found.usage.cpu_percent < 200


def test_a_load_without_an_answer_in_its_window_says_what_was_sent(
    home: Home, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = resources._usage

    def later(private: Path, seconds: float) -> tuple[resources.Usage, int, int]:
        found, began_ns, ended_ns = usage(private, seconds)
        return found, began_ns + HOUR_NS, ended_ns + HOUR_NS

    monkeypatch.setattr(resources, "_usage", later)
    said = (
        r"pbr \(replica\) at 100 Hz: in 0\.\d+ s 0 of its [1-9]\d* requests were sent, and none of these was"
        r" answered, and a node waited [\d.]+ ms for a CPU; measure again"
    )
    with pytest.raises(HarnessError, match=said):
        resources.under_load("pbr", "replica", 100.0, 0.1)


def test_a_state_of_megabytes_is_carried_where_it_stays_in_its_replica(home: Home) -> None:
    found = sweep.sized("lfr", 1_000_000, 2, 0.2)
    assert not found.refused and found.updates == 2
    assert found.cycle_us is not None and found.blackout_ms is not None


def test_a_state_that_no_packet_holds_is_carried(home: Home) -> None:
    found = sweep.sized("pbr", 100_000, 2, 0.3)
    assert not found.refused and found.updates == 2
    assert found.cycle_us is not None and found.blackout_ms is not None
