"""`aftbed bench compare`: the order, the intervals and verdicts, and what is refused.

The venvs are real ones with an aftbed that prints made-up documents, so that nothing depends on speed.
"""

import json
import sys
import venv
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec
import pytest
from liveruns import Home, aftbed, called

import aftbed as package
from aftbed.bench import compare
from aftbed.bench.compare import ComparedFigure, above, bench_compare, change, lines
from aftbed.bench.runs import TRIES
from aftbed.core.errors import ConfigError

CYCLE: Final = ComparedFigure("cycle_us")
RATE: Final = ComparedFigure("per_minute", rate=True)
SIZE: Final = ComparedFigure("pss_mb", size=True)
STUB: Final = """
import json, sys
from pathlib import Path

here = Path(__file__).parent
if sys.argv[1:] == ["--version"]:
    print("aftbed 0.0.{version}")
    sys.exit()
calls = here / "calls"
calls.write_text(calls.read_text() + " ".join(sys.argv[1:]) + chr(10) if calls.exists() else "1" + chr(10))
{body}
"""
PRINTS: Final = "print(json.dumps({document}))"
FAILS: Final = "sys.exit('aftbed: error: no such option')"
TROUBLE: Final = "print('aftbed: trouble: the machine is too busy', file=sys.stderr); sys.exit(3)"

MakeVenv = Callable[[str, str], Path]


def document(p50: float, p99: float = 9.0) -> str:
    """As an old version prints it: today's keys only."""
    times = {"p50": p50, "p95": 8.0, "p99": p99, "max": 10.0}
    return json.dumps({"ftm": "pbr", "cycle_us": times, "ring_us": times, "ratio_p50": 1.5})


@pytest.fixture
def made(tmp_path: Path) -> MakeVenv:
    """A venv whose aftbed does what `body` says."""

    def make(name: str, body: str) -> Path:
        place = tmp_path / name
        venv.create(place, with_pip=False)
        folder = next((place / "lib").glob("python3*")) / "site-packages" / "aftbed"
        folder.mkdir()
        (folder / "__main__.py").write_text(STUB.replace("{version}", str(len(name))).replace("{body}", body))
        return place

    return make


# -- order


def test_options_of_one_side_go_to_that_side_only_even_of_one_venv_twice(made: MakeVenv) -> None:
    venv = made("one", "")
    given: list[str] = []

    def measure(_: Path, bench: str) -> compare.Document:
        given.append(bench)
        return {"recovery_ms": {"p50": 1.0}}

    found = bench_compare(
        venv, venv, ("recovery",), lambda _: None, rounds=1, new_options="--rounds 1", measure=measure
    )
    assert sorted(given) == ["recovery", "recovery --rounds 1"]
    assert [line.partition(" with ")[2] for line in list(lines(found))[:2]] == ["", "--rounds 1"]


def test_the_versions_alternate_and_each_is_the_first_of_a_pair_in_turn(made: MakeVenv) -> None:
    old, new = made("old", ""), made("new!", "")
    order: list[str] = []

    def measure(place: Path, bench: str) -> compare.Document:
        order.append(f"{place.name} {bench.split(maxsplit=1)[0]}")
        return {"cycle_us": {"p50": 1.0}, "recovery_ms": {"p50": 1.0}}

    logged: list[str] = []
    bench_compare(old, new, ("cycle --ftm pbr", "recovery"), logged.append, rounds=2, measure=measure)
    assert order == [
        f"{name} {bench}" for bench in ("cycle", "recovery") for name in ("old", "new!", "new!", "old")
    ]
    assert logged[1] == f"{new}: aftbed bench cycle --ftm pbr, round 1 of 2"


# -- intervals and verdicts


@pytest.mark.parametrize(
    ("slower", "count", "verdict"),
    [
        (1.1, 11, "slower"),
        (0.9, 11, "faster"),
        (1.1, 6, "slower"),
        (1.1, 5, "not enough rounds"),
    ],
)
def test_a_change_of_all_pairs_is_shown_by_six_of_them(slower: float, count: int, verdict: str) -> None:
    old = [100.0 + 10 * number for number in range(count)]  # the machine gets slower all the time
    found = change("cycle", CYCLE, "p50", old, [slower * value for value in old])
    assert found.verdict == verdict and found.ratio == slower
    assert found.ratios == (slower,) * count
    assert (found.interval is None) == (count < 6)


def test_the_interval_is_that_of_the_sign_test() -> None:
    """Of 11 pairs, from the 2nd to the 10th ratio: that at most one is below the median has 12 of 2048."""
    found = change(
        "cycle",
        CYCLE,
        "p50",
        [1.0] * 11,
        [1 + number / 100 for number in (4, 1, 9, 3, 11, 2, 8, 5, 10, 7, 6)],
    )
    assert found.interval is not None and (found.interval.low, found.interval.high) == (1.02, 1.1)
    assert found.ratio == 1.06 and found.verdict == "slower"


def test_pairs_that_disagree_show_no_difference() -> None:
    found = change("cycle", CYCLE, "p50", [1.0] * 11, [0.9, 1.1] * 5 + [1.1])
    assert found.verdict == "no difference shown"


def test_one_disturbed_pair_of_eleven_changes_no_verdict() -> None:
    found = change("cycle", CYCLE, "p50", [1.0] * 11, [1.1] * 10 + [0.01])
    assert found.verdict == "slower"


def test_a_higher_rate_is_faster_and_a_size_is_larger() -> None:
    found = change("campaign", RATE, "", [500.0] * 6, [625.0] * 6)
    assert (found.verdict, found.ratio, found.old, found.new) == ("faster", 0.8, 500.0, 625.0)
    assert change("memory", SIZE, "", [80.0] * 6, [90.0] * 6).verdict == "larger"
    assert change("memory", SIZE, "", [80.0] * 6, [70.0] * 6).verdict == "smaller"


# -- documents


def test_an_old_version_needs_no_keys_of_today(made: MakeVenv) -> None:
    old, new = (
        made(name, PRINTS.replace("{document}", document(p50))) for name, p50 in (("old", 5.0), ("new!", 6.0))
    )
    found = bench_compare(old, new, ("cycle --ftm pbr",), lambda _: None, rounds=6)
    assert (found.old.version, found.new.version) == ("aftbed 0.0.3", "aftbed 0.0.4")
    p50, p99 = found.changes
    assert (p50.figure, p50.quantile, p50.old, p50.new, p50.ratio) == ("cycle_us", "p50", 5.0, 6.0, 1.2)
    assert p50.verdict == "slower" and p99.verdict == "no difference shown"
    assert [one.quantile for one in above(found, 1.05)] == ["p50"] and above(found, 1.2) == []
    calls = next(old.glob("lib/python3*/site-packages/aftbed/calls")).read_text().splitlines()
    assert calls[1:] == ["bench cycle --ftm pbr --json"] * 6, "behind one call that asks for its options"
    assert any(
        "cycle --ftm pbr: cycle_us p50: old 5  new 6  ratio 1.2 (1.2 to 1.2)  rounds 6  slower" in one
        for one in lines(found)
    )
    assert msgspec.json.decode(msgspec.json.encode(found), type=compare.VersionComparison) == found


def test_a_figure_that_only_one_version_has_is_left_out(made: MakeVenv) -> None:
    old, new = made("old", ""), made("new!", "")

    def measure(place: Path, bench: str) -> compare.Document:
        times = {"p50": 2.0, "max": 3.0}
        return {"launch_ms": times, "graph_ms": {"p50": 0}} | (
            {"help": {"help_ms": times}} if place == new else {}
        )

    found = bench_compare(old, new, ("launch",), lambda _: None, rounds=1, measure=measure)
    assert [(one.figure, one.quantile) for one in found.changes] == [("launch_ms", "p50")]
    assert found.left_out == ("launch: graph_ms", "launch: help.help_ms")
    assert "launch: help.help_ms: not compared, not both versions have it" in lines(found)


def test_a_version_imports_nothing_from_where_the_command_was_started(
    made: MakeVenv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither this package (PYTHONPATH) nor one in the working directory."""
    (tmp_path / "aftbed").mkdir()
    (tmp_path / "aftbed" / "__main__.py").write_text("print('aftbed of the working directory')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    made("old", "import os; print(json.dumps({'here': os.listdir()}))")
    assert compare.version_of(Path("old")) == "aftbed 0.0.3"
    assert compare.measured(Path("old"), "launch") == {"here": []}, "its own `python -m aftbed run`, too"


# -- what is refused


def test_a_venv_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"gone: no such directory; that of a venv with aftbed in it is allowed"
    ):
        bench_compare(tmp_path / "gone", tmp_path, compare.DEFAULT, lambda _: None)


def test_a_directory_that_is_no_venv(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no bin/python in it"):
        compare.version_of(tmp_path)


def test_a_venv_without_aftbed(tmp_path: Path) -> None:
    venv.create(tmp_path / "bare", with_pip=False)
    with pytest.raises(ConfigError, match=r"bare: no aftbed that works: .*No module named aftbed"):
        compare.version_of(tmp_path / "bare")


def test_a_bench_that_one_version_refuses_is_named_before_anything_is_measured(made: MakeVenv) -> None:
    refuses = f"if '--count' in sys.argv: {FAILS}\n" + PRINTS.replace("{document}", document(1.0))
    old, new = made("old", refuses), made("new!", PRINTS.replace("{document}", document(1.0)))
    logged: list[str] = []
    with pytest.raises(
        ConfigError, match=r"aftbed bench cycle --count 3 of .*/old: exit code 1: aftbed: error: no such opt"
    ):
        bench_compare(old, new, ("recovery", "cycle --count 3"), logged.append, rounds=1)
    assert logged == []


def test_a_bench_that_runs_into_trouble_is_tried_again(made: MakeVenv) -> None:
    old = made("old", TROUBLE)
    with pytest.raises(
        ConfigError, match=r"of .*/old: exit code 3: aftbed: trouble: the machine is too busy"
    ):
        compare.measured(old, "cycle")
    calls = next(old.glob("lib/python3*/site-packages/aftbed/calls")).read_text().splitlines()
    assert len(calls) == TRIES


def test_a_bench_that_prints_no_document(made: MakeVenv) -> None:
    with pytest.raises(ConfigError, match=r"aftbed bench cycle of .*/old: JSON is malformed"):
        compare.measured(made("old", "print('all is well')"), "cycle")


@pytest.mark.parametrize(
    ("bench", "message"),
    [
        ("circle", "unknown bench 'circle'; did you mean 'cycle'"),
        ("paper", "unknown bench 'paper'"),
        ("", "--bench '': no bench; cycle, hops"),
        ("cycle 'open", '--bench "cycle \'open": No closing quotation'),
    ],
)
def test_what_is_no_bench_is_refused_before_anything_is_measured(
    bench: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError) as caught:
        bench_compare(tmp_path, tmp_path, ("cycle", bench), lambda _: None)
    assert str(caught.value).startswith(message)


# -- the command


def test_the_exit_code_says_whether_the_new_version_is_above_the_ratio(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    monkeypatch.setattr(compare, "version_of", lambda venv: f"aftbed of {venv.name}")
    monkeypatch.setattr(compare, "check_options", lambda *_: None)
    monkeypatch.setattr(
        compare, "measured", lambda venv, _: json.loads(document(6.0 if venv == new else 5.0))
    )
    words = ["bench", "compare", str(old), str(new), "--bench", "cycle", "--max-ratio"]
    above_it = called(*words, "1.05", "--rounds", "6")
    assert above_it.code == 1 and "ratio 1.2 (1.2 to 1.2)  rounds 6  slower" in above_it.out, above_it.err
    assert f"bench compare: 0 of 12 measurements; {old}: aftbed bench cycle, round 1 of 6" in above_it.err
    too_few = called(*words, "1.05", "--rounds", "1", "--json")
    assert too_few.code == 0 and json.loads(too_few.out)["changes"][0]["verdict"] == "not enough rounds"
    assert called(*words, "0").err.endswith("--max-ratio 0: more than 0 is allowed, 1.05 for 5 % slower\n")


@pytest.mark.process
def test_this_version_beside_itself(home: Home, tmp_path: Path) -> None:
    """Two venvs that find this package and its libraries, as an editable installation does."""
    paths = [
        str(Path(package.__file__).parents[1]),
        *(one for one in sys.path if one.endswith("site-packages")),
    ]
    places = [tmp_path / "old", tmp_path / "new"]
    for place in places:
        venv.create(place, with_pip=False)
        (next((place / "lib").glob("python3*")) / "site-packages" / "aftbed.pth").write_text("\n".join(paths))
    bench = "cycle --count 100 --rounds 1"
    done = aftbed("bench", "compare", *places, "--bench", bench, "--rounds", "1", "--json")
    assert done.code == 0, done.err
    found = msgspec.json.decode(done.out, type=compare.VersionComparison)
    assert found.old.version == found.new.version
    assert [(one.bench, one.quantile) for one in found.changes] == [(bench, "p50"), (bench, "p99")]
    assert all(one.verdict == "not enough rounds" and one.ratio > 0 for one in found.changes)
    assert list(found.machine) == [bench] and Path(found.old.venv).is_dir()
