"""What a function declares, measured: each of `tests/functions/declaring.py` is told rightly.

Where the surroundings do not matter, the tasks are done in this process, as `exercise.perform` does them in
one of its own: a file is loaded anew for each task, so its globals are those of a fresh process.
"""

import math
import os
import time
from itertools import islice
from pathlib import Path
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.application import AccessKind, Characteristics, Field
from aftbed.core.errors import ConfigError
from aftbed.functions.load import OWN_CODE, load_module
from aftbed.judge.exercise import (
    PAGE_BYTES,
    Answer,
    Surroundings,
    Task,
    WatchStates,
    changes,
    differs,
    perform,
)
from aftbed.judge.measured import MeasuredFunction, ProcessHost, UnmeasuredError, measure
from aftbed.vehicle.aeb.function import STATE_BYTES, sample_requests

DECLARING: Final = Path(__file__).parents[1] / "functions" / "declaring.py"
VARIANTS: Final = "aftbed.vehicle.aeb.variants"
NO_STATE: Final = (True, "false", "it declares exact state access, and has false state access")
starts_process = pytest.mark.process


def requests(count: int = 40) -> list[bytes]:
    module = load_module(str(DECLARING))
    return list(islice(module.requests(0), count))


def here(name: str, count: int = 40, seed: int = 0) -> MeasuredFunction:
    """Measured in this process."""
    source = f"{DECLARING}:{name}"

    def host(task: Task, surroundings: Surroundings, seconds: float) -> Answer:
        return perform(task, source, OWN_CODE, lambda call: None)

    return measure(source, requests(count), seed, host, apart_seconds=0.0)


def elsewhere(name: str, seconds_max: float = math.inf, apart_seconds: float = 0.0) -> MeasuredFunction:
    """Measured in processes of their own."""
    source = f"{DECLARING}:{name}"
    return measure(source, requests(), host=ProcessHost(source, seconds_max), apart_seconds=apart_seconds)


# -- what does not depend on surroundings ---------------------------------------------------------


def test_a_function_that_is_what_it_declares() -> None:
    found = here("Sum")
    assert (found.deterministic, found.access, found.largest, found.serialisable) == (
        True,
        AccessKind.EXACT,
        0.0,
        True,
    )
    assert (found.wrong, found.understated, found.differences, found.remarks) == ((), (), (), ())
    assert (found.requests, found.state_bytes) == (40, 16)
    assert 1 <= found.changed_bytes.p50 <= found.changed_bytes.most <= 4
    assert (found.changed_pages.p50, found.changed_pages.most) == (1, 1)
    assert 0 < found.execute_us[0] <= found.execute_us[1]


@pytest.mark.parametrize(
    ("name", "serialisable", "told"),
    [
        ("HiddenGlobal", True, "in a new instance, restored from the initial state: the reply to request 1"),
        ("HiddenGlobal", True, "there is a state outside of the instance: in a second one, the reply to"),
        ("ForgetsField", True, "in a new instance, restored from the state behind request "),
        ("KeepsRemains", True, "restore keeps what was there: in an instance that is used, restored from"),
        ("RestoresLess", True, "in a new instance, restored from the state behind request "),
        (
            "CaptureCounts",
            True,
            "of two in a row, the second one of the initial state: count is 2 instead of",
        ),
        (
            "CaptureNumbers",
            True,
            "two in a row, the second one of the initial state: byte 16 is 0x02 instead",
        ),
        ("CaptureSpoils", True, "capture changes the state: with captures after each request, the reply to"),
        (
            "OfItsProcess",
            False,
            "the state is that of its process: in another one, restored from the initial",
        ),
        ("RefusesOwnState", False, "restored from the initial state: refused: never again"),
        (
            "RaisesInRestore",
            False,
            "the initial state: failed: RaisesInRestore: KeyError: 'sum' (",
        ),
    ],
)
def test_a_state_that_is_false(name: str, serialisable: bool, told: str) -> None:
    found = here(name)
    assert (found.deterministic, found.access_name, *found.wrong) == NO_STATE
    assert (found.largest, found.serialisable) == (None, serialisable)
    assert [text for text in found.differences if told in text], found.differences
    assert found.characteristics == Characteristics(state_access=found.characteristics.state_access)
    assert str(found.characteristics.state_access) == "none", "no mechanism may rely on it"


def test_a_difference_names_request_and_place() -> None:
    """Of numbers, the greatest one."""
    (told,) = here("ForgetsField").differences
    assert told.endswith("behind request 3: the reply to request 4: byte 8 is 0x01 instead of 0x04"), told
    found = here("ForgetsNumber")
    assert (found.access_name, found.largest) == ("approximate", 33.0)
    assert found.differences[0].endswith("the reply to request 34: count is 1 instead of 34")


@pytest.mark.parametrize(
    ("name", "access", "wrong"),
    [
        ("Mean", "approximate", ""),
        ("MeanTooGood", "approximate", "declares approximate(1e-12) state access, and has approximate"),
        ("MeanDeclaredExact", "approximate", "declares exact state access, and has approximate"),
        ("MeanWithoutFields", "false", "declares approximate(0.001) state access, and has false"),
        ("MeanOfOtherCount", "approximate", "declares approximate(0.001) state access, and has approximate"),
    ],
)
def test_a_state_that_is_approximate(name: str, access: str, wrong: str) -> None:
    found = here(name)
    assert found.access_name == access
    assert wrong in "; ".join(found.wrong) and bool(found.wrong) == bool(wrong)
    assert (found.largest is not None) == (access == "approximate")
    if name == "MeanOfOtherCount":
        assert found.largest is not None and found.largest >= 1.0, "a count is a number as well"
    elif found.largest is not None:
        assert 1e-8 < found.largest < 1e-4, "what an f32 loses of a mean of about 128"


def test_a_state_whose_bytes_differ_behind_a_restore_is_not_exact() -> None:
    """Its replies are equal, but TR compares states."""
    found = here("OtherBytes")
    assert (found.access_name, found.largest) == ("approximate", 0.0)
    assert "behind it, the state: byte 16 is 0x00 instead of 0x01" in found.differences[0]


@pytest.mark.parametrize(
    ("name", "access", "wrong", "understated"),
    [
        ("NoAccess", "none", "", ""),
        ("UndeclaredNoAccess", "none", "it declares exact state access, and has no state access", ""),
        (
            "Understated",
            "exact",
            "",
            "it does not declare to be deterministic, and no difference was found;"
            " it declares no state access, and has exact state access",
        ),
    ],
)
def test_less_than_declared_is_wrong_and_more_is_not(
    name: str, access: str, wrong: str, understated: str
) -> None:
    found = here(name)
    assert (found.access_name, "; ".join(found.wrong)) == (access, wrong)
    assert "; ".join(found.understated) == understated


def test_without_determinism_a_state_is_judged_by_its_bytes_only() -> None:
    found = here("DeclaredChance")
    assert (found.deterministic, found.access_name, found.wrong) == (False, "exact", ())
    assert "behind a restore no replies were compared" in found.remarks[0]
    assert here("Chance").wrong == ("it declares to be deterministic, and is not",)
    assert "in another process, the reply to request " in here("Chance").differences[0]


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("RaisesInExecute", "execute of request 7: RaisesInExecute: ZeroDivisionError: no more ("),
        ("RaisesInCapture", "capture of the last state: RaisesInCapture: ValueError: nothing to see ("),
        ("NoBytes", "execute of request 1: NoBytes: execute returned str, bytes are required"),
        ("Refuses", "it refused each of 40 requests"),
    ],
)
def test_what_cannot_be_measured(name: str, told: str) -> None:
    with pytest.raises(UnmeasuredError) as raised:
        here(name)
    assert str(raised.value).startswith(f"{DECLARING}:{name} cannot be measured: {told}")


def test_requests_that_are_refused_are_counted() -> None:
    refused = sum(len(request) == 1 for request in requests())
    assert refused and here("RefusesSome").remarks == (f"it refused {refused} of 40 requests",)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("OddCharacteristics", "characteristics: found {'deterministic': True}, allowed is"),
        ("OddFields", "fields: found ('sum', 'count'), allowed is a tuple of Field(...)"),
        ("Nothing", "has no class Nothing"),
    ],
)
def test_what_declares_nothing_is_an_error_of_the_user(name: str, told: str) -> None:
    with pytest.raises(ConfigError) as raised:
        here(name)
    assert told in str(raised.value)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_few_requests_are_enough(count: int) -> None:
    assert here("Sum", count).wrong == ()
    assert here("HiddenGlobal", count).wrong != ()


def test_the_seed_draws_where_states_are_restored() -> None:
    told = {seed: here("ForgetsField", seed=seed).differences for seed in (1, 2, 3)}
    assert told[1] == here("ForgetsField", seed=1).differences
    assert len(set(told.values())) > 1


# -- surroundings, crashes, hangs -----------------------------------------------------------------


@starts_process
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("HashOrder", "the reply to request 1: "),
        ("HashOrderInState", "the initial state: byte "),
        ("Address", "the reply to request 1: byte "),
        ("Environment", "the reply to request 1: 42 bytes instead of 28 bytes"),
        ("Folder", "the reply to request 1: 20 bytes instead of 17 bytes"),
    ],
)
def test_what_depends_on_its_surroundings_is_not_deterministic(name: str, told: str) -> None:
    found = elsewhere(name)
    assert found.wrong == ("it declares to be deterministic, and is not",), found
    assert found.differences[0].startswith(f"in another process, {told}"), found.differences


def test_the_two_that_watch_begin_apart() -> None:
    """Or a clock of seconds would be the same for both."""
    source, begun_s = f"{DECLARING}:Sum", []

    def host(task: Task, surroundings: Surroundings, seconds: float) -> Answer:
        if isinstance(task, WatchStates):
            begun_s.append(time.monotonic())
        return perform(task, source, OWN_CODE, lambda call: None)

    measure(source, requests(), host=host, apart_seconds=0.2)
    assert begun_s[1] - begun_s[0] >= 0.2


@starts_process
def test_what_depends_on_the_time_is_not_deterministic() -> None:
    """With a clock of seconds."""
    found = elsewhere("Second", apart_seconds=1.1)
    assert found.wrong == ("it declares to be deterministic, and is not",)


@starts_process
@pytest.mark.parametrize(
    ("source", "deterministic", "access", "state_bytes"),
    [
        ("aftbed.vehicle.aeb.function:AebFunction", True, "exact", STATE_BYTES),
        (f"{VARIANTS}:Cautious", True, "exact", STATE_BYTES + 2),
        (f"{VARIANTS}:NonDeterministic", False, "exact", STATE_BYTES),
        (f"{VARIANTS}:WithoutStateAccess", True, "none", 0),
    ],
)
def test_the_function_of_the_brake_and_its_variants(
    source: str, deterministic: bool, access: str, state_bytes: int
) -> None:
    found = measure(source, sample_requests(0, 200), apart_seconds=0.0)
    assert (found.deterministic, found.access_name, found.state_bytes) == (deterministic, access, state_bytes)
    assert (found.wrong, found.understated) == ((), ())
    assert found.serialisable == (access == "exact")


@starts_process
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("Crashes", "execute of request 7: its process ended with signal 11 (Segmentation fault)"),
        ("Leaves", "execute of request 1: its process ended with code 7"),
        ("RaisesInExecute", "execute of request 7: RaisesInExecute: ZeroDivisionError: no more ("),
    ],
)
def test_a_crash_is_told_with_its_call(name: str, told: str) -> None:
    with pytest.raises(UnmeasuredError) as raised:
        elsewhere(name)
    assert str(raised.value).startswith(f"{DECLARING}:{name} cannot be measured: {told}")


@starts_process
def test_a_hang_is_ended_and_told() -> None:
    with pytest.raises(UnmeasuredError) as raised:
        elsewhere("Hangs", seconds_max=1.5)
    assert str(raised.value).endswith("its process takes more than 1.5 s")


@starts_process
def test_a_state_that_crashes_another_process_is_false() -> None:
    found = elsewhere("CrashesElsewhere")
    assert (found.access_name, found.serialisable) == ("false", False)
    assert found.differences[-1] == (
        "the state is that of its process: in another one, restore of the initial state:"
        " its process ended with signal 11 (Segmentation fault)"
    )


@starts_process
def test_a_program_that_answers_nonsense_instead_of_the_worker(tmp_path: Path) -> None:
    """A function may write on any descriptor of its process."""
    source = tmp_path / "odd.py"
    source.write_text(
        "import os\nfor descriptor in range(3, 20):\n"
        "    try: os.write(descriptor, (5).to_bytes(8, 'little') + b'\\xc1 odd')\n"
        "    except OSError: pass\nclass Odd: ...\n"
    )
    with pytest.raises(UnmeasuredError, match="its process answered what is no answer"):
        measure(f"{source}:Odd", [b"1"])


@starts_process
def test_the_function_is_executed_in_four_other_processes(tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    source = tmp_path / "mine.py"
    source.write_text(
        f"import os\nfrom aftbed.vehicle.aeb.function import AebFunction\n"
        f"with open({str(pids)!r}, 'a') as file: print(os.getpid(), file=file)\n"
        "class Mine(AebFunction): ...\n"
    )
    assert measure(f"{source}:Mine", sample_requests(0, 3), apart_seconds=0.0).wrong == ()
    found = pids.read_text().split()
    assert len(set(found)) == 4 and str(os.getpid()) not in found
    assert not [pid for pid in found if (Path("/proc") / pid).exists()]


# -- differences ----------------------------------------------------------------------------------


FIELDS: Final = (Field("speed", "f64", 0), Field("count", "u16", 8), Field("far", "u8", 100))
small = st.binary(max_size=24)


@given(small, small)
def test_what_differs_is_told(one: bytes, other: bytes) -> None:
    text = differs(one, other, FIELDS)
    assert (text == "") == (one == other)
    if text and len(one) == len(other) and one[:8] == other[:8] and one[8:10] != other[8:10]:
        assert text.startswith("count is ")


pages = st.lists(st.sampled_from([b"\0", b"\1", b"\2"]), max_size=4).map(
    lambda found: b"".join(one * PAGE_BYTES for one in found)
)


@given(pages, small, pages, small)
def test_changes_are_counted_in_bytes_and_pages(
    before: bytes, rest: bytes, after: bytes, other_rest: bytes
) -> None:
    one, other = before + rest, after + other_rest
    count, page_count = changes(one, other)
    both = min(len(one), len(other))
    assert count == sum(a != b for a, b in zip(one, other, strict=False)) + abs(len(one) - len(other))
    touched = {at // PAGE_BYTES for at in range(both) if one[at] != other[at]}
    touched |= {at // PAGE_BYTES for at in range(both, max(len(one), len(other)))}
    assert page_count == len(touched)
