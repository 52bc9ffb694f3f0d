"""The bound of a fault's handling: above all that is simulated, near to it, and made of the scripts."""

from collections import defaultdict

import pytest

from aftbed.core.script import Suspend
from aftbed.ftm.compose import DUPLEX_EXPRESSIONS, EXPRESSIONS
from aftbed.inject.channel import ChannelFault
from aftbed.inject.crash import Crash
from aftbed.inject.hang import Hang
from aftbed.inject.model import parse
from aftbed.inject.value import ValueFlip
from aftbed.judge import handling_bound
from aftbed.judge.handling_bound import STALL_NS, bound_ms, fhti_bound
from aftbed.judge.intervals import intervals
from aftbed.judge.simulated import evidence_of_run
from aftbed.runtime.sim.world import Setup, simulate

pytestmark = pytest.mark.simulation

SEEDS = 5
NEAR = {  # the least share of its bound that the worst of a few seeds comes to
    "crash primary after {ms}ms": 0.2,
    "hang primary after {ms}ms": 0.7,
    "hang primary for 20ms after {ms}ms": 0.8,
    "crash backup after {ms}ms": 0.05,
    "hang backup after {ms}ms": 0.7,
    "crash recovery after {ms}ms": 0.3,
    "bitflip result nth {nth}": 0.05,
}


OF_HANG = ("pbr", "pbr+sup")
SUPERVISED = {
    "omission {channel} nth {nth}": 0.8,
    "duplicate {channel} nth {nth}": 0.05,
}


@pytest.mark.parametrize("ftm", ["pbr", "lfr+tr", "pbr+sup"])
def test_what_is_simulated_stays_below_the_bound_and_near_to_it(ftm: str) -> None:
    worst: dict[str, float] = defaultdict(float)
    for words in NEAR:
        for seed in range(SEEDS):
            fault = parse(words.format(ms=2 + seed, nth=5 + seed))
            rate_hz = 500 if "hang" in words else 0
            run = simulate(Setup(ftm, "process", seed, 50, rate_hz, (fault,)))
            (found,) = intervals(evidence_of_run(run))
            if found.bound_ms is None or found.fhti_ms is None:
                continue
            assert found.fhti_ms <= found.bound_ms, (str(fault), seed)
            worst[words] = max(worst[words], found.fhti_ms / found.bound_ms)
    assert len(worst) >= 5
    assert {words: share for words, share in worst.items() if share < NEAR[words]} == {}


@pytest.mark.parametrize("ftm", ["pbr+sup", "lfr+sup", "pbr+sup+tr"])
def test_so_is_what_supervision_sees(ftm: str) -> None:
    worst: dict[str, float] = defaultdict(float)
    for words in SUPERVISED:
        for seed, channel in enumerate(("prd2srv", "srv2prd", "bfr2aft")):
            fault = parse(words.format(nth=5 + seed, channel=channel))
            run = simulate(Setup(ftm, "process", seed, 50, 500, (fault,)))
            (found,) = intervals(evidence_of_run(run))
            if found.fdti_ms is None:  # TR takes no notice of a second trial, and of a third
                assert ftm.endswith("tr") and "duplicate" in words
                continue
            assert found.bound_ms is not None and found.fhti_ms is not None
            assert found.fhti_ms <= found.bound_ms, (str(fault), seed)
            worst[words] = max(worst[words], found.fhti_ms / found.bound_ms)
    assert worst.keys() == SUPERVISED.keys()
    assert {words: share for words, share in worst.items() if share < SUPERVISED[words]} == {}


def test_what_supervision_sees_has_a_bound_under_it_alone() -> None:
    for words in ("omission prd2srv", "duplicate srv2prd"):
        found = {ftm for ftm in EXPRESSIONS if bound_ms(ftm, "process", parse(words)) is not None}
        assert found == {"pbr+sup", "lfr+sup"}, words


def test_a_hang_that_is_longer_than_its_deadline_ends_in_a_failover() -> None:
    short, long = (parse(f"hang primary for {ms}ms") for ms in (19, 30))
    plain, supervised = ([bound_ms(ftm, "process", one) or 0 for one in (short, long)] for ftm in OF_HANG)
    assert plain[1] - plain[0] == pytest.approx(11)
    assert supervised[1] - supervised[0] == pytest.approx(11 + 1.85, abs=0.01), "a failover more"


def test_which_faults_of_a_leader_have_a_bound() -> None:
    of_crash = {ftm for ftm in EXPRESSIONS if fhti_bound(ftm, Crash) is not None}
    assert of_crash == set(DUPLEX_EXPRESSIONS) == {ftm for ftm in EXPRESSIONS if fhti_bound(ftm, Hang)}
    of_value = {ftm for ftm in EXPRESSIONS if fhti_bound(ftm, ValueFlip) is not None}
    assert of_value == {"tr", "pbr+tr", "lfr+tr", "assert+tr", "pbr+assert", "lfr+assert"}
    assert all(fhti_bound(ftm, ChannelFault) is None for ftm in EXPRESSIONS)


@pytest.mark.parametrize(
    "words",
    [
        "crash proxy",  # its replacement is born
        "hang recovery",
        "bitflip result at server.exit nth 3 in b",
        "crash backup at server.exit",  # the leader waits for the injector
        "slow primary by 20ms",
        "omission aft2aft",
    ],
)
def test_other_faults_have_none(words: str) -> None:
    assert bound_ms("pbr", "process", parse(words)) is None


@pytest.mark.parametrize(
    "words",
    [
        "slow primary by 20ms",  # where in a request it begins decides when it is late
        "omission pro2bfr",  # outside of what is supervised
        "omission srv2aft",  # from inside to outside
        "duplicate bfr2prd",
        "omission prd2srv permanent",
        "delay prd2srv by 5ms",
        "omission prd2srv in backup",
    ],
)
def test_nor_have_these_under_supervision(words: str) -> None:
    assert bound_ms("pbr+sup", "process", parse(words)) is None


def test_a_wrong_value_that_is_the_same_in_all_trials_has_none() -> None:
    once, lasting = parse("bitflip result"), parse("bitflip result permanent")
    assert bound_ms("pbr+tr", "process", once) is not None
    assert bound_ms("pbr+tr", "process", lasting) is None


def test_no_replica_is_left_where_one_process_has_both() -> None:
    assert bound_ms("pbr", "single", parse("crash primary")) is None


def test_the_bound_has_the_wait_for_the_next_request() -> None:
    crash, hang = parse("crash primary"), parse("hang primary")
    waits = {ms: bound_ms("pbr", "process", crash, period_ms=ms, simulated=True) for ms in (0.0, 2.0)}
    assert waits[2.0] == pytest.approx((waits[0.0] or 0) + 2)
    idle, busy = (bound_ms("pbr", "process", hang, period_ms=ms) for ms in (20.0, 10.0))
    assert idle == pytest.approx((busy or 0) + 10 + 30), "a Watchdog looks less often at an idle replica"


def test_on_real_processes_one_stop_of_the_machine_is_allowed() -> None:
    crash = parse("crash primary")
    real = bound_ms("pbr", "process", crash)
    assert real == pytest.approx((bound_ms("pbr", "process", crash, simulated=True) or 0) + STALL_NS / 1e6)


def test_a_step_more_in_the_script_of_a_failover_is_in_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    before = fhti_bound("pbr", Crash)
    declared = handling_bound.failover

    def longer(dead: str, backup: str, epoch: int) -> handling_bound.Script:
        script = declared(dead, backup, epoch)
        fence, promote, *rest = script.commit
        return handling_bound.Script(
            script.purpose, dead, (), (fence, promote, promote, *rest), kind=script.kind
        )

    monkeypatch.setattr(handling_bound, "failover", longer)
    assert fhti_bound("pbr", Crash) == pytest.approx((before or 0) + handling_bound.ORDER_NS / 1e6)
    unknown = declared("a", "b", 2)
    with pytest.raises(AssertionError, match="Suspend in a failover"):
        handling_bound._fence_ns(
            handling_bound.Script("", "", (), (Suspend("a/protocol"), *unknown.commit), kind=unknown.kind)
        )
