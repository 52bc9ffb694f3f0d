"""`aftbed ftm`: what is printed, the exit codes, and the messages about wrong words.

The command is called inside this process; see `test_bad_input`.
"""

import json
import tempfile
from functools import partial
from pathlib import Path
from typing import Final

import msgspec
import psutil
import pytest
from fakerun import Call
from hypothesis import given
from hypothesis import strategies as st

from aftbed.bench.adaptation import read_times
from aftbed.core.errors import ConfigError
from aftbed.ftm.compose import EXPRESSIONS, build

VARIANTS: Final = "aftbed.vehicle.aeb.variants"
AMPLE: Final = ("--cpus", "2", "--cpu-load", "0.1")
MINE: Final = """
from aftbed.core.application import NONE, Characteristics
class Mine:
    characteristics = Characteristics(deterministic=False, state_access=NONE)
    def execute(self, request): return b""
    def capture(self): return b""
    def restore(self, state): pass
    def acceptable(self, request, reply): return True
class Odd(Mine):
    characteristics = {"deterministic": True}
class Half:
    def execute(self, request): return b""
"""


@pytest.fixture
def call(call: Call) -> Call:
    """Call `aftbed ftm` with these arguments: exit code, output, errors."""
    return partial(call, "ftm")


# -- list and show


def test_every_expression_is_listed_with_its_processes(call: Call) -> None:
    code, out, _ = call("list")
    rows = [line.split() for line in out.splitlines()]
    assert code == 0
    assert [row[0] for row in rows] == ["FTM", *EXPRESSIONS]
    assert {row[0]: row[-1] for row in rows[1:]}.items() >= {"pbr": "17", "lfr+tr": "23", "tr": "11"}.items()
    assert len({line.rindex(line.split()[-2]) for line in out.splitlines()[1:]}) == 1, "in columns"


def test_the_list_as_a_document(call: Call) -> None:
    code, out, _ = call("list", "--json")
    found = {row["ftm"]: row for row in json.loads(out)}
    assert code == 0 and list(found) == list(EXPRESSIONS)
    assert found["lfr"] == {
        "ftm": "lfr",
        "tolerates": ["crash"],
        "detects": [],
        "needs": {
            "deterministic": [
                "lfr needs a deterministic function: two replicas execute every request",
            ],
            "state_access": [],
            "exact_state": [],
        },
        "cpus": 2,
        "cpu_load": "high",
        "bandwidth": "low",
        "processes": 17,
    }


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_an_expression_is_shown_with_all_its_bricks_and_channels(call: Call, expression: str) -> None:
    graph = build(expression, "process")
    code, out, _ = call("show", expression, "--json")
    found = json.loads(out)
    assert code == 0
    assert [brick["name"] for brick in found["bricks"]] == [brick.name for brick in graph.bricks]
    assert len(found["channels"]) == len(graph.links)
    code, out, _ = call("show", expression)
    assert code == 0
    assert all(brick.part in out for brick in graph.bricks)
    assert {k.name for k in graph.links} == {
        word for word in out.split() if word in {k.name for k in graph.links}
    }


@pytest.mark.parametrize(
    ("expression", "words"),
    [
        (
            "lfr+tr",
            ("crash, value, implausible", "tr needs state access", "before, tr.protocol, tr."),
        ),
        ("tr", ("1 CPU, high CPU load, no bandwidth", "11, one per brick")),
        ("pbr+sup", ("tolerates  crash, flow", "23, one per brick", "sup.before")),
        ("assert", ("tolerates  nothing", "detects    implausible", "nothing of the function")),
        ("lfr+assert+tr", ("29, one per brick",)),
    ],
)
def test_the_requirements_of_an_expression_are_shown(
    call: Call, expression: str, words: tuple[str, ...]
) -> None:
    code, out, _ = call("show", expression)
    assert code == 0
    assert [word for word in words if word not in out] == []
    assert "b/protocol ->" not in out.replace("proxy", ""), "the second replica is as the first"


# -- check


@pytest.mark.parametrize(
    ("arguments", "code", "last"),
    [
        (("--ftm", "pbr"), 0, "pbr is consistent"),
        ((), 0, "consistent: pbr, lfr, pbr+assert, pbr+sup, lfr+assert, lfr+sup, pbr+tr"),
        (("--faults", "crash,value"), 0, "consistent: pbr+tr, lfr+tr"),
        (
            ("--ftm", "pbr", "--app", f"{VARIANTS}:WithoutStateAccess"),
            1,
            "pbr is not consistent; consistent: lfr, lfr+assert",
        ),
        (("--ftm", "lfr", "--app", f"{VARIANTS}:WithoutStateAccess"), 0, "lfr is consistent"),
        (
            ("--ftm", "lfr", "--app", f"{VARIANTS}:NonDeterministic"),
            1,
            "lfr is not consistent; consistent: pbr, pbr+assert",
        ),
        (("--ftm", "lfr+tr", "--app", f"{VARIANTS}:Cautious"), 0, "lfr+tr is consistent"),
        (
            ("--ftm", "lfr+tr", "--app", f"{VARIANTS}:WithoutStateAccess", "--faults", "crash,value"),
            1,
            "lfr+tr is not consistent; no consistent FTM",
        ),
        (("--faults", "value", "--app", f"{VARIANTS}:NonDeterministic"), 1, "no consistent FTM"),
        (
            ("--ftm", "none"),
            1,
            "none is not consistent; consistent: pbr, lfr, pbr+assert",
        ),
        (("--ftm", "none", "--faults", "none"), 0, "none is consistent"),
        (
            ("--ftm", "pbr", "--bandwidth", "100"),
            1,
            "pbr is not consistent; consistent: lfr, lfr+assert",
        ),
        (("--bandwidth", "0"), 1, "no consistent FTM"),
    ],
)
def test_the_last_line_and_the_exit_code_are_the_answer(
    call: Call, arguments: tuple[str, ...], code: int, last: str
) -> None:
    found, out, err = call("check", *arguments, *AMPLE)
    assert err == ""
    assert out.splitlines()[-1].startswith(last)
    assert found == code


def test_reasons_and_measured_resources_are_printed(call: Call) -> None:
    arguments = ("--ftm", "pbr+tr", "--app", f"{VARIANTS}:WithoutStateAccess", "--bandwidth", "10")
    _, out, _ = call("check", *arguments, "--faults", "crash,value", "--cpus", "1", "--cpu-load", "0.75")
    assert out.splitlines() == [
        "faults     crash, value",
        f"function   deterministic, no state access ({VARIANTS}:WithoutStateAccess)",
        "resources  1 CPU, load 75%, 10 kbit/s",
        "because    pbr needs state access: each checkpoint carries the whole state to the backup",
        "           tr needs state access: every execution starts from the same state",
        "           pbr+tr needs 2 CPUs, found 1",
        "           pbr+tr takes much CPU: found a load of 75%, allowed are 50%",
        "           pbr+tr takes much bandwidth: found 10 kbit/s, needed are 256",
        "pbr+tr is not consistent; no consistent FTM",
    ]


def test_a_remark_on_a_follower_that_cannot_be_replaced(call: Call) -> None:
    code, out, _ = call("check", "--ftm", "lfr", "--app", f"{VARIANTS}:WithoutStateAccess", *AMPLE)
    assert code == 0
    assert "remark     lfr without state access: after a failover the survivor stays alone\n" in out


def test_the_answer_as_a_document(call: Call) -> None:
    code, out, _ = call("check", "--ftm", "lfr", "--app", f"{VARIANTS}:NonDeterministic", *AMPLE, "--json")
    assert code == 1
    assert json.loads(out) == {
        "ftm": "lfr",
        "consistent": False,
        "problems": ["lfr needs a deterministic function: two replicas execute every request"],
        "remarks": [],
        "consistent_ftms": ["pbr", "pbr+assert", "pbr+sup"],
        "faults": ["crash"],
        "app": f"{VARIANTS}:NonDeterministic",
        "characteristics": {"deterministic": False, "state_access": "exact", "tolerance": 0.0},
        "resources": {"cpus": 2, "cpu_load": 0.1, "bandwidth_kbit_s": None},
    }


def test_resources_that_are_not_given_are_measured(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    _, out, _ = call("check", "--json")
    found = json.loads(out)["resources"]
    assert found["cpus"] == len(psutil.Process().cpu_affinity())
    assert 0.0 <= found["cpu_load"] <= 1.0
    monkeypatch.setattr(psutil, "cpu_percent", lambda seconds: 97.0)
    monkeypatch.setattr(psutil.Process, "cpu_affinity", lambda self: [0])
    code, out, _ = call("check", "--ftm", "pbr", "--json")
    assert code == 1 and json.loads(out)["resources"]["cpu_load"] == pytest.approx(0.97)
    assert json.loads(out)["problems"][0] == "pbr needs 2 CPUs, found 1"
    code, out, _ = call("check", "--ftm", "pbr", "--json", "--cpus", "4")
    assert json.loads(out)["resources"]["cpus"] == 4


def test_a_function_from_a_file(call: Call, tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(MINE)
    code, out, _ = call("check", "--app", f"{path}:Mine", *AMPLE)
    assert code == 1 and out.endswith("no consistent FTM\n")


def test_a_table_of_the_user_replaces_rows(call: Call, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("rows: [{mechanism: pbr, tolerates: [crash, value], cpus: 1}]\n")
    arguments = ("--ftm", "pbr", "--app", f"{VARIANTS}:WithoutStateAccess", "--faults", "value")
    assert call("check", *arguments, *AMPLE)[0] == 1
    assert call("check", *arguments, *AMPLE, "--table", str(path))[0] == 0
    assert "1 CPU, low CPU load, no bandwidth" in call("show", "pbr", "--table", str(path))[1]
    assert "crash, value" in call("list", "--table", str(path))[1].splitlines()[2]


# -- resilience

TIMES: Final = {
    "from": "pbr",
    "to": "lfr",
    "recipe": "drained",
    "placement": "process",
    "adaptations": 7,
    "blackout_ms": {"p50": 2.5},
    "total_ms": {"p50": 120.0},
    "back": {"blackout_ms": {"p50": 1.5}, "total_ms": {"p50": 110.0}},
}


def test_the_resilience_of_a_set(call: Call) -> None:
    code, out, _ = call("resilience", "--set", "tr,pbr", "--adaptations", "0")
    lines = out.splitlines()
    assert code == 0
    assert lines[:2] == ["set         pbr, tr", "can run     tr, pbr, pbr+tr"]
    lost = next(line for line in lines if line.startswith("A     state access  exact") and " no " in line)
    assert lost.split()[-1] == "0.0%", "both need the state"
    assert next(line for line in lines if line.startswith("pbr+tr      tr ")).split()[3:] == ["-", "-", "-"]
    assert lines[-1].startswith("answered    ") and "that break what runs" in lines[-1]
    assert "measuring" not in out and "without service" not in out
    more = [
        line.split("  ")[0] for line in lines[lines.index("") :] if line.startswith(("assert ", "one like"))
    ]
    assert more[0] == "assert" and len(more) == 6, "what is shipped stands first, then the best five"


def test_a_set_that_never_adapts(call: Call) -> None:
    code, out, _ = call("resilience", "--set", "pbr")
    assert code == 0, "nothing is measured"
    assert "ADAPT FROM" not in out and out.splitlines()[-1].startswith("answered    ")


def test_the_resilience_as_a_document(call: Call, tmp_path: Path) -> None:
    path = tmp_path / "times.json"
    path.write_text(json.dumps(TIMES))
    arguments = ("resilience", "--set", "pbr,lfr", "--adaptations", "0", "--times", str(path), "--json")
    code, out, _ = call(*arguments)
    found = json.loads(out)
    assert code == 0
    keys = "mechanisms ftms situations states total kinds changes adaptations additions adaptation_mean"
    assert set(found) == set(keys.split())
    assert (found["mechanisms"], found["ftms"]) == (["pbr", "lfr"], ["pbr", "lfr"])
    assert [one["kind"] for one in found["kinds"]] == ["FT", "A", "R"]
    assert set(found["changes"][0]) == {"kind", "axis", "from", "to", "counts"}
    there, back = sorted(found["adaptations"], key=lambda one: one["from"], reverse=True)
    assert {**there, "changes": 0} == {
        "from": "pbr",
        "to": "lfr",
        "changes": 0,
        "blackout_ms": 2.5,
        "total_ms": 120.0,
        "of": 4,
        "source": str(path),
    }
    mean_ms = (2.5 * there["changes"] + 1.5 * back["changes"]) / (there["changes"] + back["changes"])
    assert found["adaptation_mean"]["blackout_ms"] == pytest.approx(mean_ms, abs=1e-3)
    assert found["adaptation_mean"]["changes"] == found["total"]["adapts"]
    assert {one["addition"] for one in found["additions"]} >= {"as_shipped", "tolerates", "less_bandwidth"}


def test_the_way_back_of_a_result_is_left_out_where_there_is_none(call: Call, tmp_path: Path) -> None:
    path = tmp_path / "times.json"
    path.write_text(json.dumps({name: value for name, value in TIMES.items() if name != "back"}))
    _, out, _ = call("resilience", "--set", "pbr,lfr", "--adaptations", "0", "--times", str(path), "--json")
    found = json.loads(out)["adaptations"]
    assert sorted((one["from"], one["source"]) for one in found if one["source"]) == [("pbr", str(path))]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", ("times.json: line 1, column 2: not YAML here", "aftbed bench adapt --json")),
        ("[]", ("found [], allowed is keys and values", "aftbed bench adapt --json")),
        (
            json.dumps(TIMES | {"total_ms": {"p50": -1}}),
            ("total_ms.p50: found -1, allowed is a number",),
        ),
        (json.dumps(TIMES | {"to": "lfrr"}), ("from pbr to lfrr", "did you mean 'lfr'")),
        (json.dumps(TIMES | {"recipe": "paper"}), ("found recipe paper", "allowed are drained and process")),
        (
            json.dumps(TIMES | {"placement": "single"}),
            ("placement single", "allowed are drained and process"),
        ),
        (json.dumps(TIMES | {"to": "pbr"}), ("an update; allowed is an adaptation to another mechanism",)),
        (
            json.dumps(TIMES | {"to": "lfr+tr"}),
            ("found pbr to lfr+tr and lfr+tr to pbr", "this set adapts", "pbr to lfr"),
        ),
    ],
)
def test_times_that_are_none(call: Call, tmp_path: Path, content: str, words: tuple[str, ...]) -> None:
    path = tmp_path / "times.json"
    path.write_text(content)
    code, out, err = call("resilience", "--set", "pbr,lfr", "--times", str(path))
    assert (code, out) == (2, "")
    assert err.startswith(f"aftbed: error: --times {path}: ")
    assert [word for word in words if word not in err] == []


@given(
    st.binary(max_size=300)
    | st.dictionaries(st.sampled_from([*TIMES, "x"]), st.text()).map(msgspec.json.encode)
)
def test_whatever_stands_in_a_file_of_times_is_read_or_refused(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "times.json"
        path.write_bytes(data)
        with pytest.raises(ConfigError, match=r"times\.json: "):
            read_times(path)


# -- bad input


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("show", "pbrr"), ("unknown FTM 'pbrr'", "did you mean 'pbr'")),
        (("show", "tr+pbr"), ("tr+pbr", "pbr+tr?")),
        (("show", ""), ("unknown FTM ''",)),
        (("check", "--ftm", "lfr+rt"), ("unknown FTM 'rt'", "did you mean 'tr'")),
        (("check", "--ftm", ""), ("unknown FTM ''",)),
        (("check", "--faults", "crsh"), ("unknown fault 'crsh'", "did you mean 'crash'", "implausible")),
        (("check", "--app", f"{VARIANTS}:Cautios"), (f"{VARIANTS}:Cautios", "Cautious")),
        (("check", "--app", "aftbed.gone:Mine"), ("aftbed.gone:Mine", "cannot be imported")),
        (("check", "--app", "mine"), ("'mine' names no function", "MODULE:CLASS, FILE.py:CLASS")),
        (("check", "--app", "gone.py:Mine"), ("gone.py", "no such file")),
        (("check", "--cpus", "0"), ("--cpus 0", "1 to 1024")),
        (("check", "--cpu-load", "1.5"), ("--cpu-load 1.5", "0 to 1")),
        (("check", "--cpu-load", "nan"), ("--cpu-load nan",)),
        (("check", "--bandwidth", "-1"), ("--bandwidth -1", "kbit/s")),
        (("check", "--bandwidth", "inf"), ("--bandwidth inf",)),
        (("resilience", "--set", ""), ("--set ''", "a set without a mechanism answers nothing")),
        (("resilience", "--set", "pbr,lfrr"), ("--set 'pbr,lfrr'", "unknown mechanism 'lfrr'", "'lfr'")),
        (("resilience", "--set", "pbr+tr"), ("pbr+tr is a composition", "pbr,tr is allowed")),
        (("resilience", "--adaptations", "-1"), ("--adaptations -1", "0 to 1000")),
        (("resilience", "--times", "gone.json"), ("--times gone.json", "No such file")),
        (("resilience", "--table", "gone.yaml"), ("gone.yaml", "No such file")),
        (("list", "--table", "gone.yaml"), ("gone.yaml", "No such file")),
    ],
)
def test_bad_input_is_exit_code_2(call: Call, arguments: tuple[str, ...], words: tuple[str, ...]) -> None:
    code, out, err = call(
        *arguments, *(AMPLE if arguments[0] == "check" and "--cpu" not in arguments[1] else ())
    )
    assert (code, out) == (2, "")
    assert err.startswith("aftbed: error: ")
    assert [word for word in words if word not in err] == []


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Half", ("no protected function", "capture, restore, characteristics")),
        ("Odd", ("Odd: characteristics: found {", "allowed is Characteristics(...)")),
        ("Mien", ("no class Mien", "Half, Mine, Odd")),
    ],
)
def test_a_class_that_is_no_function(call: Call, tmp_path: Path, name: str, words: tuple[str, ...]) -> None:
    path = tmp_path / "mine.py"
    path.write_text(MINE)
    code, out, err = call("check", "--app", f"{path}:{name}", *AMPLE)
    assert (code, out) == (2, "")
    assert [word for word in words if word not in err] == []


def test_a_file_that_is_no_table(call: Call, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("rows: [{mechanism: pbt}]\n")
    code, _, err = call("list", "--table", str(path))
    assert (
        code == 2
        and f"{path}: line 1, column 20: rows[0].mechanism: unknown FTM 'pbt'; did you mean 'pbr'" in err
    )
