"""`aftbed explore order` and `aftbed sim --against`: what is counted, what is compared, what is refused."""

import json
from pathlib import Path

import pytest
from playedrun import Call

from aftbed.cli import simagainst
from aftbed.search.agreement import Agreement, Times, apart

LFR = ("explore", "order", "--ftm", "lfr", "--placement", "replica")


def test_every_order_is_counted_and_the_bound_is_said(call: Call) -> None:
    code, out, _ = call(*LFR, "--requests", "2", "--bound", "20")
    lines = out.splitlines()
    assert code == 0
    assert lines[0] == "all 2 orders (3 cut): lfr (replica), seed 0, 1 request"
    assert lines[1] == "all 6 orders (13 cut): lfr (replica), seed 0, 2 requests"
    assert all(line.startswith("at least ") for line in lines[2:-1]), "20 runs are not enough with a crash"
    assert "all orders of 2 of " in lines[-1] and "the others up to 20 runs each" in lines[-1]


def test_as_one_document(call: Call) -> None:
    code, out, _ = call(*LFR, "--requests", "1", "--bound", "5", "--json")
    found = json.loads(out)
    assert code == 0 and found["explored"] == found["survived"] > 0
    assert (found["bound"], found["complete"], found["broken"]) == (5, 1, [])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((*LFR, "--bound", "0"), "--bound 0: 1 to 10000000 are allowed"),
        ((*LFR, "--requests", "0"), "--requests 0: 1 to 1000 are allowed"),
        (("explore", "order", "--ftm", "lfrr"), "'lfrr'"),
        (("sim", "--against", "/nowhere"), "/nowhere/run.json: No such file or directory"),
        (("sim", "--against", "/nowhere", "--ftm", "lfr"), "--against: the experiments are the records'"),
        (("sim", "--against", "/nowhere", "--seeds", "5..4"), "5..4"),
    ],
)
def test_bad_input(call: Call, arguments: tuple[str, ...], words: str) -> None:
    code, _, err = call(*arguments)
    assert code == 2 and words in err


FAST = Times(20, 0.2, 0.4, 0.6)


@pytest.mark.parametrize(
    ("real", "words"),
    [
        (Times(3, 0.5, 0.55, 3.0), ""),  # the real median lies among the simulated times
        (Times(3, 0.3, 0.7, 3.0), ""),  # the simulated median lies among the real ones
        (Times(3, 0.7, 0.9, 3.0), "recovery: real median 0.9 ms, simulated 0.2 to 0.6 ms"),
        (None, "only one of them has failovers"),
    ],
)
def test_times_agree_where_a_median_lies_within_the_other(real: Times | None, words: str) -> None:
    assert apart(real, FAST) == ([words] if words else [])


@pytest.mark.parametrize(("why_not", "code"), [((), 0), (("not alike",), 1)])
def test_what_does_not_agree_is_an_exit_code(
    call: Call, monkeypatch: pytest.MonkeyPatch, why_not: tuple[str, ...], code: int
) -> None:
    one = Agreement("pbr process", {"masked": 1}, {"masked": 20}, FAST, None, why_not)
    monkeypatch.setattr(simagainst, "against", lambda records, seeds: [one] if seeds == 3 else [])
    found, out, _ = call("sim", "--against", str(Path("there")), "--seeds", "0..2", "--json")
    assert (found, json.loads(out)["agree"]) == (code, not why_not)
