"""`aftbed bench all`: each line finds its figure and its limit, and the table is put into a page."""

import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Final

import msgspec
import pytest
from liveruns import Home

from aftbed.bench.numbers import (
    BEGIN,
    END,
    LINES,
    QUICK,
    Document,
    Number,
    Numbers,
    bench_all,
    check_page,
    figure_at,
    markdown,
    not_measured,
    write_into,
)
from aftbed.bench.runs import TRIES
from aftbed.core.errors import ConfigError, HarnessError

TIMES: Final = {"p50": 2.0, "p95": 3.0, "p99": 4.0, "max": 5.0}
RATIO: Final = {
    "p50": {"median": 1.234, "q1": 1.111, "q3": 1.456, "all": 1.3},
    "p99": {"median": 2.0, "q1": 1.9, "q3": 2.5, "all": 2.345},
    "rounds": 11,
}
BESIDE: Final = {"limit": {**TIMES, "p50": 1.0, "name": "the limit"}, "ratio": RATIO}
DOCUMENTS: Final[dict[str, Document]] = {  # by the first word of a command
    "cycle": {"cycle_us": TIMES, **BESIDE},
    "hops": {"hop_ns": {"p1": 5, "p50": 9}, **BESIDE},
    "recovery": {
        "recovery_ms": TIMES,
        **BESIDE,
        "parts_ms": {"detection": TIMES, "fencing": TIMES},
    },
    "adapt": {
        "blackout_ms": TIMES,
        "steps_ms": {"suspend": TIMES, "bind+unbind": TIMES},
        **BESIDE,
        "back": {"blackout_ms": TIMES, "steps_ms": {"suspend": TIMES}, "ratio": RATIO | {"rounds": 7}},
        "requests": {"sent": 100, "lost": 1, "duplicated": 0, "reordered": 0, "wrong": 0},
        "stuck": 2,
    },
    "launch": {
        "launch_ms": {"p50": 700, "max": 800},
        "graph_ms": {"p50": 38, "max": 40},
        **BESIDE,
        "help": {"help_ms": {"p50": 150, "max": 160}, **BESIDE},
    },
    "memory": {
        "pss_mb": 80.0,
        "idle_cpu_percent": 1.5,
        "others": {"zygote": {"processes": 2, "pss_mb": 20.0}},
    },
    "campaign": {"per_minute": 700, "cpu_ms": 230, "experiment_ms": 90.5, **BESIDE},
    "simulator": {"requests_per_s": 13954, "request_us": TIMES, **BESIDE},
    "state": {
        "cycle_us": TIMES,
        "beside_cycle_us": {"p50": 1.5},
        "ratio_p50": 1.3,
        **BESIDE,
        "blackout_ms": TIMES,
        "beside_blackout_ms": {"p50": 0.5},
        "blackout_ratio_p50": 4.0,
    },
}


def fake(command: str) -> Document:
    return DOCUMENTS[command.split(maxsplit=1)[0]]


def measured() -> Numbers:
    (found,) = bench_all(lambda _: None, measure=fake)
    return found


def line(what: str, command: str = "") -> Number:
    return next(
        one for one in measured().numbers if one.what.startswith(what) and one.command.endswith(command)
    )


def test_each_command_is_run_once() -> None:
    logged: list[str] = []
    list(bench_all(logged.append, measure=fake))
    assert len(logged) == len(set(logged)) == len({one.command for one in LINES})
    assert logged[0] == "aftbed bench cycle --ftm pbr"


def test_a_quick_run_measures_less() -> None:
    logged: list[str] = []
    (found,) = bench_all(logged.append, quick=True, measure=fake)
    assert logged[0] == "aftbed bench cycle --ftm pbr --count 1000 --rounds 2"
    assert found.quick and found.numbers[0].command == "aftbed bench cycle --ftm pbr"
    assert set(QUICK) <= set(DOCUMENTS)


def test_a_command_that_fails_is_tried_again() -> None:
    logged: list[str] = []

    def flaky(command: str) -> Document:
        if len(logged) == 1:
            raise HarnessError("the machine is too busy")
        return fake(command)

    (found,) = bench_all(logged.append, measure=flaky)
    assert found.numbers == measured().numbers
    assert logged[1] == "aftbed bench cycle --ftm pbr, again (the machine is too busy)"


def failing_in(passes: int, *, of: int) -> Numbers:
    """`of` passes, in the first `passes` of which the memory cannot be measured."""
    begun: Counter[str] = Counter()

    def measure(command: str) -> Document:
        begun[command] += 1
        if command.startswith("memory") and begun[command] <= TRIES * passes:
            raise HarnessError(f"too busy | the {begun[command]}. time")
        return fake(command)

    logged: list[str] = []
    *_, found = bench_all(logged.append, passes=of, measure=measure)
    assert sum(line.startswith("not measured: ") for line in logged) == passes
    return found


def test_a_command_that_fails_leaves_the_other_lines() -> None:
    """It is told, misses its goal, and is none of those with a value."""
    found = failing_in(1, of=1)
    assert not_measured(found) == ["aftbed bench memory --ftm pbr"]
    rest = [one for one in found.numbers if one.measured]
    assert rest == [one for one in measured().numbers if "memory" not in one.command]
    (row,) = [row for row in markdown(found) if row.startswith("| memory of")]
    why = "aftbed bench memory --ftm pbr: failed 3 times, the last time: too busy / the 3. time"
    assert row.startswith(f"| memory of the 17 processes (PSS) | **not measured**: {why} |")
    assert row.count("|") == 7 and "at most 70: **missed**" in row


def test_a_pass_without_a_value_is_not_in_the_median_and_is_told() -> None:
    found = failing_in(2, of=3)
    assert not not_measured(found)
    (row,) = [row for row in markdown(found) if row.startswith("| memory of")]
    assert "| 80 MB; failed in 2 passes: aftbed bench memory --ftm pbr: failed 3 times" in row
    assert not_measured(failing_in(3, of=3)) == ["aftbed bench memory --ftm pbr"]


def test_a_cycle_stands_beside_its_ring() -> None:
    found = line("cycle under `pbr`, a process per brick")
    assert found.measured == TIMES and found.limit_p50 == 1.0
    assert found.ratios == {"p50": 1.23} and found.goal == {"p50": 1.35} and found.met


def test_a_cycle_is_measured_in_turn_with_that_of_another_mechanism() -> None:
    found = line("cycle under `lfr`", "--ftm lfr --beside pbr")
    assert found.ratios == {"p50": 1.23} and found.met is False
    assert (found.quartiles, found.rounds) == ((1.11, 1.46), 11)


def test_the_ratio_is_that_of_the_document_and_its_p99_is_over_all_rounds() -> None:
    found = line("SIGKILL")
    assert found.limit == "the limit" and found.limit_p50 == 1.0
    assert found.ratios == {"p50": 1.23, "p99": 2.35} and found.met
    assert (found.quartiles, found.rounds) == ((1.11, 1.46), 11)
    assert line("and back").rounds == 7
    assert line("its parts").measured == {"detection": 2.0, "fencing": 2.0}


def test_a_ratio_to_another_size_is_a_number_of_its_own() -> None:
    found = line("cycle under `pbr`, 1 MB")
    assert found.ratios == {"p50": 1.3} and found.limit == "the same with 10 kB" and found.limit_p50 == 1.5


def test_a_figure_of_one_value_a_round_stands_beside_its_limit() -> None:
    found = line("time of one of them")
    assert found.measured == {"p50": 90.5} and found.ratios == {"p50": 1.23}


def test_requests_that_are_lost_miss_the_goal() -> None:
    found = line("the requests meanwhile")
    assert found.measured["sent"] == 100 and found.met is False


def test_more_experiments_a_minute_are_better() -> None:
    assert line("experiments a minute on real").met
    assert line("experiments a minute in the sim").met is False


def test_what_has_no_goal_is_not_judged() -> None:
    assert line("cycle of the bare server").met is None


def test_the_figures_at_a_path() -> None:
    document = {"a": {"x": {"p50": 1}, "y": {"p50": 2}}, "n": 3}
    assert figure_at(document, "n") == {"": 3.0}
    assert figure_at(document, "a.x") == {"p50": 1}
    assert figure_at(document, "a.*.p50") == {"x": 1.0, "y": 2.0}


def test_a_row_of_the_table() -> None:
    rows = [row for row in markdown(measured()) if row.startswith("| memory of")]
    goal = "at most 70: **missed** | `aftbed bench memory --ftm pbr` |"
    assert rows == [f"| memory of the 17 processes (PSS) | 80 MB |  |  | {goal}"]
    rows = [row for row in markdown(measured()) if row.startswith("| start of")]
    assert rows[0].startswith(
        "| start of a run to a reply | p50 700, max 800 ms | the limit: 1 ms | p50 1.23 (1.11 to 1.46) |"
    )


@pytest.mark.parametrize(
    ("percent", "words"), [(2.6, "2.6 % steal"), (0.0, "0 % steal"), (None, "unknown steal")]
)
def test_the_table_says_what_was_stolen_meanwhile(percent: float | None, words: str) -> None:
    found = measured()
    machine = msgspec.structs.replace(found.machine, steal_percent=percent)
    first = next(markdown(msgspec.structs.replace(found, machine=machine)))
    assert first.endswith(f"; {words} meanwhile.")


def test_every_row_has_as_many_cells_as_the_head() -> None:
    rows = [row for row in markdown(measured()) if row.startswith("|")]
    assert len(rows) == len(LINES) + 2 and {row.count("|") for row in rows} == {7}


# -- several passes

PASSES: Final = (1.4, 1.1, 1.2, 1.8, 1.3)


def in_passes() -> list[Numbers]:
    """Of passes in which nothing but the ratios, the memory and what was lost differs."""
    begun: Counter[str] = Counter()

    def measure(command: str) -> Document:
        this = PASSES[begun[command]]
        begun[command] += 1
        found = fake(command)
        if "ratio" in found:
            found = {**found, "ratio": {**RATIO, "p50": {**RATIO["p50"], "median": this}}}
        return found | ({"pss_mb": 10 * this} if command.startswith("memory") else {})

    return list(bench_all(lambda _: None, passes=len(PASSES), measure=measure))


def test_the_median_of_several_passes_stands_with_its_quartiles() -> None:
    found = in_passes()
    assert [one.passes for one in found] == [1, 2, 3, 4, 5]
    cycle = found[-1].numbers[0]
    assert cycle.ratios == {"p50": 1.3} and cycle.quartiles == (1.2, 1.4) and cycle.met
    assert found[0].numbers[0].ratios == {"p50": 1.4} and found[0].numbers[0].met is False
    rows = list(markdown(found[-1]))
    assert " `aftbed bench all --passes 5` " in rows[0] and "median of 5 passes" in rows[0]
    assert any("| p50 1.3 (1.2 to 1.4) |" in row for row in rows)


def test_a_figure_without_a_limit_has_its_quartiles_over_passes() -> None:
    (row,) = [row for row in markdown(in_passes()[-1]) if row.startswith("| memory of")]
    assert "| 13 (12 to 14) MB |" in row


def test_what_is_lost_in_any_pass_is_added_up() -> None:
    found = next(one for one in in_passes()[-1].numbers if one.what == "the requests meanwhile")
    assert (found.measured["sent"], found.measured["lost"]) == (500, 5)
    assert found.met is False and found.quartiles is None


# -- into a page


def test_the_table_takes_the_place_of_the_last_one(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"# A\n\n{BEGIN}\nold\n{END}\n\nafter\n")
    check_page(page)
    write_into(page, measured())
    write_into(page, measured())
    text = page.read_text()
    assert text.startswith(f"# A\n\n{BEGIN}\nMeasured on 2") and text.endswith(f"|\n{END}\n\nafter\n")
    assert text.count(BEGIN) == 1 and "old" not in text


@pytest.mark.parametrize("text", ["", f"{BEGIN}\n", f"{END}\n{BEGIN}\n", f"{BEGIN}\n{BEGIN}\n{END}\n"])
def test_a_page_without_its_markers_is_refused(text: str, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(ConfigError, match=f"--into {page}: it needs the lines"):
        check_page(page)


def test_a_page_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gone\.md: No such file"):
        check_page(tmp_path / "gone.md")


def test_the_page_of_the_project_has_its_markers() -> None:
    check_page(Path(__file__).resolve().parents[2] / "docs" / "numbers.md")


# -- real runs


@pytest.mark.process
@pytest.mark.deep
@pytest.mark.timeout(1200)
def test_every_line_is_measured(home: Home) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "aftbed", "bench", "all", "--quick", "--json"],
        capture_output=True,
        text=True,
        timeout=1100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = msgspec.json.decode(done.stdout, type=Numbers)
    assert [one.what for one in found.numbers] == [one.what for one in LINES]
    for one in found.numbers:
        assert one.measured and all(value >= 0 for value in one.measured.values()), one
        assert not one.limit or one.ratios["p50"] > 0, one
