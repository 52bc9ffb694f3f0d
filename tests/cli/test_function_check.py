"""`aftbed app`: what is printed, the exit codes, and the messages about wrong words."""

import json
import sys
from functools import partial
from pathlib import Path
from typing import Final

import pytest
from fakerun import Call, Output

from aftbed.ftm.compose import EXPRESSIONS
from aftbed.judge import measured

DECLARING: Final = Path(__file__).parents[1] / "functions" / "declaring.py"
REQUESTS: Final = ("--requests", f"{DECLARING}:requests", "--count", "40")
VARIANTS: Final = "aftbed.vehicle.aeb.variants"
starts_process = pytest.mark.process


@pytest.fixture
def call(call: Call, monkeypatch: pytest.MonkeyPatch) -> Call:
    """Call `aftbed app` with these arguments: exit code, output, errors. No function here reads a clock."""
    monkeypatch.setattr(measured, "APART_SECONDS", 0.0)
    return partial(call, "app")


# -- header


def test_the_header_of_a_library_is_in_the_package(call: Call) -> None:
    code, out, _ = call("header")
    header = Path(out.rstrip("\n"))
    assert (code, header.name) == (0, "aft.h")
    assert "aft_execute" in header.read_text()


# -- check


@starts_process
def test_a_function_that_is_what_it_declares_as_a_document(call: Call) -> None:
    source = f"{VARIANTS}:NonDeterministic"
    code, out, err = call("check", source, "--json")
    found = json.loads(out)
    assert code == 0 and err.startswith("aftbed: note: in another process, the reply to request")
    assert list(found) == [
        "app", "kind", "declared", "measured", "state_bytes", "changed_bytes", "changed_pages", "execute_us",
        "suits",
    ]  # fmt: skip
    assert (found["app"], found["kind"], found["state_bytes"]) == (source, "class", 452)
    assert found["declared"] == {"deterministic": False, "state_access": "exact"}
    assert found["measured"] == {
        "deterministic": False,
        "state_access": "exact",
        "difference_max": 0.0,
        "serialisable": True,
    }
    assert list(found["changed_bytes"]) == list(found["changed_pages"]) == ["p50", "max"]
    assert list(found["execute_us"]) == ["p50", "p99"]
    suits = {one["ftm"]: one["why_not"] for one in found["suits"]}
    assert list(suits) == list(EXPRESSIONS)
    suited = [name for name, why_not in suits.items() if not why_not]
    assert suited == ["none", "pbr", "assert", "sup", "pbr+assert", "pbr+sup"]
    assert suits["lfr"] == "lfr needs a deterministic function: two replicas execute every request"


@starts_process
def test_what_is_false_is_seen_at_once(call: Call) -> None:
    source = f"{DECLARING}:ForgetsField"
    code, out, err = call("check", source, *REQUESTS)
    assert (code, err) == (1, "")
    lines = out.splitlines()
    assert lines[:5] == [
        f"function   {source} (class), 40 requests",
        "declared   deterministic, exact state access",
        "measured   deterministic, false state access, also in another process",
        "false      it declares exact state access, and has false state access",
        "because    in a new instance, restored from the state behind request 3: the reply to request 4:"
        " byte 8 is 0x01 instead of 0x04",
    ]
    assert "suits      none, lfr, assert, sup, lfr+assert, lfr+sup" in lines
    assert lines[-1] == f"{source} is not what it declares"


@starts_process
@pytest.mark.parametrize(
    ("name", "words", "said"),
    [
        ("Crashes", REQUESTS, "execute of request 7: its process ended with signal 11"),
        (
            "Refuses",
            (),
            "it refused each of 200 requests (the requests are those of the brake function; --re",
        ),
    ],
)
def test_what_cannot_be_measured_is_trouble(call: Call, name: str, words: tuple[str, ...], said: str) -> None:
    code, out, err = call("check", f"{DECLARING}:{name}", *words)
    assert (code, out) == (3, "")
    assert err.startswith(f"aftbed: trouble: {DECLARING}:{name} cannot be measured: {said}")
    assert err.count("\n") == 1, "one line, no traceback"


@starts_process
def test_requests_of_a_file_are_executed(call: Call, tmp_path: Path) -> None:
    (tmp_path / "requests.csv").write_text("hex\n01\n0203\n04\n")
    code, out, _ = call(
        "check", f"{DECLARING}:Understated", "--requests", tmp_path / "requests.csv", "--count", "2"
    )
    assert code == 0, "to be more than declared is no danger"
    assert "2 requests" in out.splitlines()[0]
    assert "remark     it does not declare to be deterministic, and no difference was found" in out


FIXED: Final = """
import json, sys
for line in sys.stdin:
    asked = json.loads(line)
    number, given = asked["id"], asked.get("execute")
    answer = {"describe": {"state_access": "none"}}
    if given is not None:
        fixed = len(given) == 72 and given.startswith("01")
        answer = {"execute": "00"} if fixed else {"error": "no request of a car in the fixed layout"}
    print(json.dumps({"id": number, **answer}), flush=True)
"""


@starts_process
def test_a_program_is_asked_for_the_brake_in_the_fixed_layout(call: Call, tmp_path: Path) -> None:
    (tmp_path / "fixed.py").write_text(FIXED)
    code, out, err = call("check", f"{sys.executable} -I -S {tmp_path}/fixed.py", "--count", "20")
    assert (code, err) == (0, "")
    assert "measured   deterministic, no state access" in out and "refused" not in out


# -- bad input


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("mine",), "'mine' names no function; MODULE:CLASS, FILE.py:CLASS, FILE.so"),
        (("none.py:Mine",), "none.py: no such file"),
        (("none.so",), "none.so: no such file"),
        ((f"{VARIANTS}:Cautious", "--count", "0"), "--count 0: 1 to 100000 are allowed"),
        ((f"{VARIANTS}:Cautious", "--count", "100001"), "--count 100001: 1 to 100000 are allowed"),
        ((f"{VARIANTS}:Cautious", "--seed", "-1"), "--seed -1: 0 to"),
        ((f"{VARIANTS}:Cautious", "--requests", "none.csv"), "none.csv: no such file"),
        ((f"{VARIANTS}:Cautious", "--requests", "{three}", "--count", "4"), "--count 4: 1 to 3 are allowed"),
        ((f"{VARIANTS}:Cautious", "--requests", f"{DECLARING}:none"), "declaring.py has no function none"),
        (("no.such.module:Mine",), "no.such.module:Mine cannot be read: no module no"),
    ],
)
def test_bad_input_is_refused(
    refused: Output, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "three.csv").write_text("hex\n01\n02\n03\n")
    assert said in refused("check", *(word.replace("{three}", "three.csv") for word in words))


@starts_process
def test_what_is_no_function_is_refused(refused: Output) -> None:
    assert "found {'deterministic': True}, allowed is Characteristics(...)" in refused(
        "check", f"{DECLARING}:OddCharacteristics"
    )
    assert f"{VARIANTS} has no class Careless (it has: " in refused("check", f"{VARIANTS}:Careless")
