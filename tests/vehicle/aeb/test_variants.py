"""The variants differ from the function in exactly what they declare, and drive as safely."""

from collections.abc import Callable
from functools import cache
from typing import Final

import puredrive
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sampling import sampled

from aftbed.core.application import EXACT, NONE, Application, Characteristics, StateAccess
from aftbed.core.errors import PeerError
from aftbed.vehicle.aeb import variants
from aftbed.vehicle.aeb.function import STATE_BYTES, default_application, sample_requests
from aftbed.vehicle.aeb.messages import STAGE_NONE, STAGE_WARN, AebOutput, decode_reply, encode_reply
from aftbed.vehicle.aeb.variants import (
    CALM_TTC_S,
    EARLY_TTC_S,
    NOISE_PART,
    Cautious,
    NonDeterministic,
    WithoutStateAccess,
)
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.scenario import broken_expectations

Make = Callable[[], Application]
VARIANTS: Final[tuple[Make, ...]] = (WithoutStateAccess, NonDeterministic, Cautious)
REQUESTS: Final = sample_requests(3, 600)

every_variant = pytest.mark.parametrize("make", VARIANTS)


def after(make: Make, count: int) -> Application:
    """One that has executed the first `count` requests."""
    application = make()
    for request in REQUESTS[:count]:
        application.execute(request)
    return application


@pytest.mark.parametrize(
    ("make", "deterministic", "state_access"),
    [(WithoutStateAccess, True, NONE), (NonDeterministic, False, EXACT), (Cautious, True, EXACT)],
)
def test_each_declares_one_difference_at_most(
    make: Make, deterministic: bool, state_access: StateAccess
) -> None:
    assert make().characteristics == Characteristics(deterministic, state_access)


def test_the_module_has_no_other_variant() -> None:
    classes = {value for value in vars(variants).values() if isinstance(value, type)}
    assert {c for c in classes if c.__module__ == variants.__name__} == set(VARIANTS)


def differs(make: Make) -> bool:
    """Whether two of them that were asked the same have given different replies, or hold different states."""
    pair = make(), make()
    replies = [[one.execute(request) for request in REQUESTS] for one in pair]
    return replies[0] != replies[1] or pair[0].capture() != pair[1].capture()


@every_variant
def test_what_it_declares_of_determinism_is_so(make: Make) -> None:
    assert differs(make) != make().characteristics.deterministic


def goes_on(make: Make) -> bool:
    """Whether one that was restored gives the stages and demands that the captured one gives."""
    old, new = after(make, 200), make()
    new.restore(old.capture())
    outputs = [[decode_reply(one.execute(r)) for r in REQUESTS[200:260]] for one in (old, new)]
    return [(o.stage, o.counter) for o in outputs[0]] == [(o.stage, o.counter) for o in outputs[1]]


@every_variant
def test_what_it_declares_of_state_access_is_so(make: Make) -> None:
    assert goes_on(make) == (make().characteristics.state_access == EXACT)


def test_the_state_of_the_one_without_access_is_nothing_and_only_that_is_taken() -> None:
    locked = after(WithoutStateAccess, 100)
    witness = after(default_application, 100)
    assert locked.capture() == b""
    locked.restore(b"")
    with pytest.raises(PeerError, match="state of 452 bytes, expected none"):
        locked.restore(bytes(STATE_BYTES))
    assert locked.execute(REQUESTS[100]) == witness.execute(REQUESTS[100]), "it is as it was"


def test_chance_is_in_the_time_to_collision_and_nowhere_else() -> None:
    chance, witness = NonDeterministic(), default_application()
    seen = 0
    for request in REQUESTS:
        found, expected = decode_reply(chance.execute(request)), decode_reply(witness.execute(request))
        assert (found.ttc_s is None) == (expected.ttc_s is None)
        if found.ttc_s is not None and expected.ttc_s is not None:
            assert found.ttc_s == pytest.approx(expected.ttc_s, rel=NOISE_PART)
            seen += found.ttc_s != expected.ttc_s
        rest = (found.stage, found.deceleration_ms2, found.slot, found.counter)
        assert rest == (expected.stage, expected.deceleration_ms2, expected.slot, expected.counter)
    assert seen > len(REQUESTS) / 2
    assert chance.capture() == witness.capture()


def test_version_2_warns_earlier_and_is_version_1_otherwise() -> None:
    cautious, witness = Cautious(), default_application()
    early = 0
    for request in REQUESTS:
        found, expected = decode_reply(cautious.execute(request)), decode_reply(witness.execute(request))
        if found.stage == expected.stage:
            assert found == expected
            continue
        early += 1
        assert (expected.stage, found.stage) == (STAGE_NONE, STAGE_WARN)
        assert found.ttc_s is not None and found.ttc_s <= CALM_TTC_S
        assert (found.deceleration_ms2, found.counter) == (0.0, expected.counter)
    assert early > 10


class Told:
    """A function whose replies are the time to collision that it is asked with; its state is one byte."""

    characteristics = Characteristics()

    def execute(self, request: bytes) -> bytes:
        """Decides nothing."""
        ttc_s = float(request) if request else None
        return encode_reply(AebOutput(STAGE_NONE, 0.0, ttc_s, 0, 0))

    def capture(self) -> bytes:
        """As long as the function's."""
        return bytes(STATE_BYTES)

    def restore(self, state: bytes) -> None:
        """Any."""

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        """All."""
        return True


def warns(cautious: Cautious, ttc_s: float | None) -> bool:
    """Whether it warns at this time to collision."""
    request = b"" if ttc_s is None else str(ttc_s).encode()
    return decode_reply(cautious.execute(request)).stage == STAGE_WARN


def test_an_early_warning_does_not_flicker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variants, "default_application", Told)
    assert CALM_TTC_S > EARLY_TTC_S
    cautious = Cautious()
    near, far = EARLY_TTC_S, CALM_TTC_S
    told = [None, far, near + 0.1, near, near + 0.1, far, far + 0.1, far, near, None, near + 0.1]
    assert [warns(cautious, ttc_s) for ttc_s in told] == [
        *(False, False, False, True, True, True, False, False, True, False, False)
    ]


def test_an_early_warning_is_state(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variants, "default_application", Told)
    old, other = Cautious(), Cautious()
    assert warns(old, EARLY_TTC_S)
    other.restore(old.capture())
    assert warns(other, CALM_TTC_S)
    other.migrate(bytes(STATE_BYTES))
    assert not warns(other, CALM_TTC_S), "version 1 had none"
    assert warns(old, CALM_TTC_S)
    old.restore(Cautious().capture())
    assert not warns(old, CALM_TTC_S)


@given(st.integers(0, len(REQUESTS) - 1))
def test_version_2_restored_goes_on_bit_for_bit(count: int) -> None:
    old, new = after(Cautious, count), Cautious()
    new.restore(old.capture())
    assert new.capture() == old.capture()
    for request in REQUESTS[count : count + 60]:
        assert new.execute(request) == old.execute(request)


def test_version_2_takes_over_from_version_1() -> None:
    old, new = after(default_application, 300), Cautious()
    new.migrate(old.capture())
    assert new.capture()[2:] == old.capture()
    for request in REQUESTS[300:400]:
        found, expected = decode_reply(new.execute(request)), decode_reply(old.execute(request))
        assert found.stage >= expected.stage and found.counter == expected.counter


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda state: b"", "state of 0 bytes, expected 454"),
        (lambda state: state[2:], "state of 452 bytes, expected 454"),
        (lambda state: state + b"\0", "state of 455 bytes, expected 454"),
        (lambda state: b"\x01" + state[1:], "state of version 1, expected 2"),
        (lambda state: b"\x02\x02" + state[2:], "early warning of 2, allowed is 0 or 1"),
        (lambda state: b"\x02\x01\x09" + state[3:], "state of version 9, expected 1"),
    ],
)
def test_a_state_that_is_none_is_refused(spoil: Callable[[bytes], bytes], reason: str) -> None:
    cautious = after(Cautious, 150)
    before = cautious.capture()
    with pytest.raises(PeerError, match=reason):
        cautious.restore(spoil(before))
    assert cautious.capture() == before


def test_version_2_migrates_no_state_of_its_own() -> None:
    cautious = after(Cautious, 150)
    before = cautious.capture()
    with pytest.raises(PeerError):
        cautious.migrate(before)
    assert cautious.capture() == before


@every_variant
@pytest.mark.parametrize("request_", [b"", b"\xc1", bytes(2000)])
def test_a_bad_request_is_refused_and_changes_nothing(make: Make, request_: bytes) -> None:
    application = after(make, 120)
    before = application.capture()
    with pytest.raises(PeerError):
        application.execute(request_)
    assert application.capture() == before


@every_variant
def test_the_assertion_accepts_what_it_replies(make: Make) -> None:
    application = make()
    for request in REQUESTS:
        assert application.acceptable(request, application.execute(request))


class Fixed:
    """A generator without chance."""

    def __init__(self, value: float) -> None:
        self._value = value

    def uniform(self, low: float, high: float) -> float:
        """Always the same."""
        assert low <= self._value <= high
        return self._value


@pytest.mark.parametrize("noise", [-NOISE_PART, NOISE_PART])
def test_chance_never_makes_a_reply_that_is_not_acceptable(
    noise: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(variants, "SystemRandom", lambda: Fixed(noise))
    chance, witness = NonDeterministic(), default_application()
    kept = 0
    for request in REQUESTS:
        found, expected = chance.execute(request), witness.execute(request)
        assert witness.acceptable(request, found)
        kept += found == expected and decode_reply(expected).ttc_s is not None
    assert (kept > 0) == (noise < 0), "one that is just above the limit of a warning must not fall below it"


@every_variant
def test_the_assertion_is_the_functions(make: Make) -> None:
    application, witness = make(), default_application()
    for request in REQUESTS[:50]:
        for spoilt in (b"", request, application.execute(request)[:-1]):
            assert application.acceptable(request, spoilt) == witness.acceptable(request, spoilt)


@cache
def driven_by_the_function(name: str) -> puredrive.Drive:
    """What each variant is compared with; to be called before the function is replaced."""
    scenario = load_scenario(name)
    return puredrive.drive(scenario.plant, scenario.duration_ms)


@pytest.mark.parametrize(
    ("make", "name"), sampled(VARIANTS, ("ccrs-50", "ccrm-50", "ccrb-50-12m", "free-drive"))
)
def test_the_car_drives_as_the_scenario_expects(
    make: Make, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = load_scenario(name)
    witness = driven_by_the_function(name)
    monkeypatch.setattr(puredrive, "AebFunction", make)
    driven = puredrive.drive(scenario.plant, scenario.duration_ms)
    assert broken_expectations(scenario, driven.result) == []
    assert driven.result == witness.result, "it brakes as the function does"


def test_version_2_warns_the_driver_sooner(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = load_scenario("ccrs-50")
    before = puredrive.drive(scenario.plant, 4000).first_s(STAGE_WARN)
    monkeypatch.setattr(puredrive, "AebFunction", Cautious)
    found = puredrive.drive(scenario.plant, 4000).first_s(STAGE_WARN)
    assert before is not None and found is not None
    assert found < before - 0.5
