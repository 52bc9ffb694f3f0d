"""FT, A and R against the table: each assumption is named where it does not hold, and nowhere else."""

import re
from pathlib import Path
from typing import Final

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.adapt.suitability import (
    FAULTS,
    ROWS,
    TABLE,
    FaultModel,
    Limits,
    Resources,
    Row,
    SuitabilityTable,
    TableFile,
    consistent,
    demand,
    fault_model,
    problems,
    refusal,
    remarks,
    table_from,
)
from aftbed.core import messages
from aftbed.core.application import EXACT, NONE, Characteristics, approximate
from aftbed.core.errors import ConfigError
from aftbed.core.messages import Checkpoint, Notification, Request
from aftbed.core.yaml_file import in_file, read_yaml
from aftbed.ftm.compose import DUPLEX, EXPRESSIONS, parse
from aftbed.ftm.registry import MECHANISMS
from aftbed.vehicle.aeb.function import default_application, sample_requests

OPEN: Final = Characteristics()
CLOSED: Final = Characteristics(state_access=NONE)
ROUGH: Final = Characteristics(state_access=approximate(1e-3))
RANDOM: Final = Characteristics(deterministic=False)
NEITHER: Final = Characteristics(deterministic=False, state_access=NONE)
AMPLE: Final = Resources(cpus=2, cpu_load=0.0)
CRASH: Final = FaultModel(crash=True)
VALUE: Final = FaultModel(crash=False, value=True)
IMPLAUSIBLE: Final = FaultModel(crash=False, implausible=True)
FLOW: Final = FaultModel(crash=False, flow=True)
NOTHING: Final = FaultModel(crash=False)

expressions = st.sampled_from(EXPRESSIONS)
models = st.builds(FaultModel, st.booleans(), st.booleans(), st.booleans(), st.booleans())
functions = st.builds(Characteristics, st.booleans(), st.sampled_from([EXACT, NONE, approximate(1e-3)]))
machines = st.builds(
    Resources,
    st.integers(1, 4),
    st.sampled_from((0.0, 0.5, 0.51, 0.9, 0.91, 1.0)),
    st.sampled_from((None, 0.0, 63.9, 64.0, 255.9, 256.0, 1e6)),
)


# -- the rows


def test_every_mechanism_has_its_row() -> None:
    assert [row.mechanism for row in ROWS] == list(MECHANISMS)


@pytest.mark.parametrize(
    ("expression", "tolerates", "deterministic", "state_access", "cpus", "load", "bandwidth"),
    [  # the design's table, and what follows from it
        ("none", (), False, False, 1, "low", "none"),
        ("pbr", ("crash",), False, True, 2, "low", "high"),
        ("lfr", ("crash",), True, False, 2, "high", "low"),
        ("tr", ("value", "implausible"), True, True, 1, "high", "none"),
        ("assert", (), False, False, 1, "low", "none"),
        ("sup", (), False, False, 1, "low", "none"),
        ("pbr+tr", ("crash", "value", "implausible"), True, True, 2, "high", "high"),
        ("lfr+tr", ("crash", "value", "implausible"), True, True, 2, "high", "low"),
        ("pbr+assert", ("crash", "implausible"), False, True, 2, "low", "high"),
        ("lfr+assert", ("crash", "implausible"), True, False, 2, "high", "low"),
        ("pbr+sup", ("crash", "flow"), False, True, 2, "low", "high"),
        ("pbr+sup+tr", ("crash", "value", "implausible", "flow"), True, True, 2, "high", "high"),
        ("assert+tr", ("value", "implausible"), True, True, 1, "high", "none"),
        ("lfr+assert+tr", ("crash", "value", "implausible"), True, True, 2, "high", "low"),
    ],
)
def test_what_an_expression_tolerates_and_needs(
    expression: str,
    tolerates: tuple[str, ...],
    deterministic: bool,
    state_access: bool,
    cpus: int,
    load: str,
    bandwidth: str,
) -> None:
    found = demand(expression)
    assert found.tolerates == tolerates
    assert (bool(found.deterministic), bool(found.state_access)) == (deterministic, state_access)
    assert (found.cpus, found.cpu_load, found.bandwidth) == (cpus, load, bandwidth)


@given(expressions)
def test_a_composition_needs_what_its_parts_need_and_tolerates_what_they_do(expression: str) -> None:
    whole, parts = demand(expression), [demand(name) for name in parse(expression)]
    assert set(whole.tolerates) >= {fault for part in parts for fault in part.tolerates}
    assert whole.deterministic == tuple(reason for part in parts for reason in part.deterministic)
    assert whole.state_access == tuple(reason for part in parts for reason in part.state_access)
    assert all(whole.cpus >= part.cpus for part in parts)


def test_the_limits_of_bandwidth_carry_the_function_at_50_requests_a_second() -> None:
    function = default_application()
    requests = sample_requests(1, 500)
    replies = [function.execute(request) for request in requests]
    last = 2**32
    by_state = max(
        len(messages.encode(Checkpoint(last, last, reply, function.capture()))) for reply in replies
    )
    by_request = max(len(messages.encode(Request(last, last, request))) for request in requests)
    by_request += len(messages.encode(Notification(last, last, bytes(32))))
    limits = TABLE.limits
    assert by_request * 8 * 50 / 1000 <= limits.low_bandwidth_kbit_s_min
    assert limits.low_bandwidth_kbit_s_min < by_state * 8 * 50 / 1000 <= limits.high_bandwidth_kbit_s_min


# -- problems


@pytest.mark.parametrize(
    ("expression", "function", "found"),
    [
        ("pbr", OPEN, []),
        ("pbr", RANDOM, []),
        ("pbr", CLOSED, ["pbr needs state access: each checkpoint carries the whole state to the backup"]),
        ("lfr", OPEN, []),
        ("lfr", CLOSED, []),
        ("lfr", RANDOM, ["lfr needs a deterministic function: two replicas execute every request"]),
        ("pbr+tr", CLOSED, ["pbr needs state access: ", "tr needs state access: every execution starts"]),
        ("lfr+tr", CLOSED, ["tr needs state access: every execution starts from the same state"]),
        ("lfr+tr", RANDOM, ["lfr needs a deterministic function: ", "tr needs a deterministic function: "]),
        ("pbr+tr", RANDOM, ["tr needs a deterministic function: executions of one request are compared"]),
        ("pbr+assert", RANDOM, []),
        ("lfr+assert", CLOSED, []),
        ("lfr+assert", NEITHER, ["lfr needs a deterministic function: "]),
        ("pbr", ROUGH, []),
        ("lfr", ROUGH, []),
        ("pbr+tr", ROUGH, ["tr needs exact state access: executions from one state are compared bit by bit"]),
    ],
)
def test_an_assumption_on_the_function_is_named(
    expression: str, function: Characteristics, found: list[str]
) -> None:
    reasons = problems(expression, CRASH, function, AMPLE)
    assert len(reasons) == len(found), reasons
    assert all(reason.startswith(start) for reason, start in zip(reasons, found, strict=True)), reasons


@pytest.mark.parametrize(
    ("expression", "faults", "found"),
    [
        ("none", NOTHING, []),
        ("none", CRASH, ["none does not tolerate crashes (it tolerates nothing)"]),
        ("tr", VALUE, []),
        ("tr", FaultModel(), ["tr does not tolerate crashes (it tolerates value, implausible)"]),
        ("pbr", FaultModel(True, True), ["pbr does not tolerate value faults (it tolerates crash)"]),
        ("pbr+tr", FaultModel(True, True, True), []),
        ("pbr+assert", FaultModel(True, False, True), []),
        (
            "pbr+assert",
            FaultModel(True, True, True),
            ["pbr+assert does not tolerate value faults (it tolerates crash, implausible)"],
        ),
        ("pbr+tr", FLOW, ["pbr+tr does not tolerate flow faults (it tolerates crash, value, implausible)"]),
        (
            "assert",
            IMPLAUSIBLE,
            [
                "assert detects implausible value faults and can only stop:"
                " there is no second replica to execute instead"
            ],
        ),
    ],
)
def test_a_fault_that_is_not_tolerated_is_named(
    expression: str, faults: FaultModel, found: list[str]
) -> None:
    assert problems(expression, faults, OPEN, AMPLE) == found


@pytest.mark.parametrize(
    ("expression", "resources", "found"),
    [
        ("pbr", Resources(1), ["pbr needs 2 CPUs, found 1"]),
        ("tr", Resources(1), []),
        ("pbr", Resources(2, 0.9), []),
        ("pbr", Resources(2, 0.91), ["pbr takes little CPU: found a load of 91%, allowed are 90%"]),
        ("lfr", Resources(2, 0.5), []),
        ("lfr", Resources(2, 0.51), ["lfr takes much CPU: found a load of 51%, allowed are 50%"]),
        ("pbr", Resources(2, 0, 256), []),
        ("pbr", Resources(2, 0, 255), ["pbr takes much bandwidth: found 255 kbit/s, needed are 256"]),
        ("lfr", Resources(2, 0, 64), []),
        ("lfr", Resources(2, 0, 63), ["lfr takes little bandwidth: found 63 kbit/s, needed are 64"]),
        ("tr", Resources(2, 0, 0), []),
        ("pbr+tr", Resources(1, 0.6, 1), ["needs 2 CPUs", "takes much CPU", "takes much bandwidth"]),
    ],
)
def test_a_resource_that_does_not_suffice_is_named(
    expression: str, resources: Resources, found: list[str]
) -> None:
    faults = FaultModel(crash=expression != "tr")
    reasons = problems(expression, faults, OPEN, resources)
    assert len(reasons) == len(found), reasons
    assert all(part in reason for reason, part in zip(reasons, found, strict=True)), reasons


def test_an_expression_that_is_none_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown FTM 'pbrr'; did you mean 'pbr'"):
        problems("pbrr", CRASH, OPEN, AMPLE)
    with pytest.raises(ConfigError, match="lfr replicates, so it can only be outermost"):
        demand("pbr+lfr")


# -- what would do


@pytest.mark.parametrize(
    ("faults", "function", "found"),
    [
        (CRASH, OPEN, ["pbr", "lfr", "pbr+assert", "pbr+sup", "lfr+assert", "lfr+sup", "pbr+tr", "lfr+tr"]),
        (CRASH, CLOSED, ["lfr", "lfr+assert", "lfr+sup"]),
        (CRASH, RANDOM, ["pbr", "pbr+assert", "pbr+sup"]),
        (CRASH, NEITHER, []),
        (VALUE, OPEN, ["tr", "assert+tr", "pbr+tr", "lfr+tr"]),
        (VALUE, RANDOM, []),
        (FaultModel(True, True), OPEN, ["pbr+tr", "lfr+tr"]),
        (FaultModel(True, True), CLOSED, []),
        (FaultModel(True, False, True), CLOSED, ["lfr+assert"]),
        (FaultModel(True, False, True), RANDOM, ["pbr+assert"]),
        (FLOW, OPEN, ["pbr+sup", "lfr+sup"]),
        (FLOW, RANDOM, ["pbr+sup"]),
        (NOTHING, NEITHER, ["none", "assert", "sup"]),
    ],
)
def test_the_expressions_that_would_do_the_cheapest_first(
    faults: FaultModel, function: Characteristics, found: list[str]
) -> None:
    assert consistent(faults, function, AMPLE) == found


@given(models, functions, machines)
def test_what_would_do_is_what_has_no_problem(
    faults: FaultModel, function: Characteristics, machine: Resources
) -> None:
    found = consistent(faults, function, machine)
    assert len(set(found)) == len(found)
    assert set(found) == {e for e in EXPRESSIONS if not problems(e, faults, function, machine)}


@given(models, functions, machines)
def test_more_of_everything_loses_nothing(
    faults: FaultModel, function: Characteristics, machine: Resources
) -> None:
    found = set(consistent(faults, function, machine))
    assert found <= set(consistent(faults, OPEN, machine))
    assert found <= set(consistent(faults, function, Resources(8, 0.0, None)))
    assert found <= set(consistent(NOTHING, function, machine))


@given(expressions, models, functions, machines)
def test_a_refusal_names_every_problem_and_what_would_do(
    expression: str, faults: FaultModel, function: Characteristics, machine: Resources
) -> None:
    found = problems(expression, faults, function, machine)
    others = consistent(faults, function, machine)
    text = refusal(expression, faults, function, machine)
    assert (text == "") == (found == [])
    assert all(reason in text for reason in found)
    if found:
        assert (", ".join(others) in text) if others else ("no consistent FTM" in text)


@given(expressions, functions)
def test_a_follower_that_cannot_be_renewed_is_remarked(expression: str, function: Characteristics) -> None:
    alone = parse(expression)[:1] in [(name,) for name in DUPLEX] and function.state_access == NONE
    assert [("survivor" in remark) for remark in remarks(expression, function)] == ([True] if alone else [])


# -- words and files


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("crash", FaultModel()),
        ("none", NOTHING),
        ("value,crash", FaultModel(True, True)),
        ("implausible", IMPLAUSIBLE),
        ("flow", FLOW),
    ],
)
def test_a_fault_model_in_words(text: str, found: FaultModel) -> None:
    assert fault_model(text) == found


@pytest.mark.parametrize("text", ["valeu", "crash,valeu", "", "crash,", "crash value", "none,crash"])
def test_words_that_are_no_fault_model(text: str) -> None:
    with pytest.raises(ConfigError, match=r"unknown fault .*one of: crash, flow, implausible, none, value"):
        fault_model(text)


@given(models)
def test_the_words_of_a_fault_model_are_read_again(model: FaultModel) -> None:
    assert fault_model(",".join(model.asked()) or "none") == model
    assert set(model.asked()) <= set(FAULTS)


MINE: Final = """
rows:
  - {mechanism: lfr, tolerates: [crash], cpus: 3, cpu_load: low, bandwidth: none}
limits: {low_cpu_load_max: 0.2}
"""


def read_table(path: Path) -> SuitabilityTable:
    file = read_yaml(path, TableFile)
    with in_file(path):
        return table_from(file)


def test_a_users_table_lies_over_the_shipped_one(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(MINE)
    table = read_table(path)
    assert table.limits == Limits(low_cpu_load_max=0.2)
    assert table.rows["pbr"] == TABLE.rows["pbr"]
    assert problems("lfr", CRASH, NEITHER, Resources(3, 0.1, 0), table) == []
    assert problems("lfr", CRASH, NEITHER, AMPLE, table) == ["lfr needs 3 CPUs, found 2"]
    assert consistent(CRASH, OPEN, Resources(2, 0.3), table) == ["pbr+tr"]
    assert "lfr" in refusal("pbr", CRASH, CLOSED, Resources(3, 0.1, 0), table)
    assert TABLE.rows["lfr"].cpus == 2, "the shipped one is as it was"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("rows: [{mechanism: lrf}]", "rows[0].mechanism: unknown FTM 'lrf'; did you mean 'lfr'?"),
        ("rows: [{mechanism: lfr}, {mechanism: lfr}]", "rows: found 2 for lfr, allowed is one"),
        ("rows: [{mechanism: lfr, tolerates: [crsh]}]", "rows[0].tolerates[0]: found 'crsh', allowed is one"),
        ("rows: [{mechanism: lfr, cpus: 0}]", "rows[0].cpus: found 0, allowed is a whole number at least 1"),
        ("rows: [{mechanism: lfr, cpu: 1}]", "rows[0]: unknown key 'cpu'; did you mean 'cpus'?"),
        ("rows: [{mechanism: lfr, bandwidth: huge}]", "rows[0].bandwidth: found 'huge'"),
        ("limits: {low_cpu_load_max: 2}", "limits.low_cpu_load_max: found 2"),
        ("limits: {high_bandwidth_kbit_s_min: .nan}", "limits.high_bandwidth_kbit_s_min: found nan"),
        ("rowz: []", "unknown key 'rowz'; did you mean 'rows'?"),
    ],
)
def test_a_table_that_is_none_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        read_table(path)
    assert re.match(f"{path}: line \\d+, column \\d+: {re.escape(reason)}", str(error.value)), error.value


def test_a_table_is_data() -> None:
    file = TableFile(tuple(TABLE.rows.values()), TABLE.limits)
    assert msgspec.convert(msgspec.to_builtins(file), TableFile) == file
    assert table_from(file) == TABLE
    assert isinstance(file.rows[0], Row)
