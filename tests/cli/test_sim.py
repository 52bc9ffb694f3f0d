"""`aftbed sim`: what is printed of one run and of many, the exit codes, how a failure is repeated."""

import itertools
import json
import re
import shlex
import sys
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

import pytest
from fakerun import Call, Output
from msgspec.structs import replace

from aftbed.cli.sim import SHRUNK_MAX, repeating
from aftbed.core.messages import Goal, Scheduled
from aftbed.functions.load import NO_CODE, Code
from aftbed.inject.crash import Crash
from aftbed.inject.grammar import Trigger
from aftbed.inject.model import Fault
from aftbed.judge.asked import AskedAdaptation
from aftbed.runtime.sim.world import Doom, Setup
from aftbed.runtime.unix.worker_pool import each
from aftbed.search.agreement import Agreement, RecoveryRange, apart
from aftbed.search.explore import tried
from aftbed.search.swarm import drawn

pytestmark = pytest.mark.simulation

UNREPEATABLE: Final = "aftbed.vehicle.aeb.variants:NonDeterministic"
FLIP: Final = ("--ftm", "pbr", "--count", "10", "--inject", "bitflip result bit 60 nth 3")  # no TR: sdc


@pytest.fixture
def call(call: Call) -> Call:
    """Call `aftbed` with one process that simulates: exit code, output, errors."""

    def aftbed(*arguments: str | Path) -> tuple[int, str, str]:
        words = set(map(str, arguments))
        many = {"--seeds", "--minutes"} & words and "--against" not in words
        return call(*arguments, *(("--jobs", "1") if many else ()))

    return aftbed


@pytest.fixture
def sim(call: Call) -> Call:
    """Call `aftbed sim`."""
    return partial(call, "sim")


# -- one run


def test_one_run_is_printed_between_its_seeds(sim: Call) -> None:
    code, out, err = sim("--seed", "7", "--count", "20", "--inject", "crash primary at server.exit nth 3")
    lines = out.splitlines()
    assert (code, err) == (0, "")
    assert lines[0] == lines[-1] == "seed 7"
    assert lines[1] == "pbr (process), seed 7, 20 requests; crash primary at server.exit nth 3"
    assert "  requests   20 sent, 20 answered, 0 lost, 0 duplicated, 0 late, 0 wrong" in lines
    assert any(line.startswith("  failover   to epoch 2: detected 0.") for line in lines)
    assert "  fault      crash primary at server.exit nth 3: activated" in lines
    assert re.search(r"^[0-9.]+ ms of virtual time in [0-9.]+ ms; outcome: tolerated$", out, re.MULTILINE)
    assert lines[-2] == "verdict: pass"


def test_a_fault_that_is_handled_later_than_the_ftti_fails(sim: Call) -> None:
    crash = ("--count", "20", "--inject", "crash primary at server.exit nth 3")
    code, out, _ = sim(*crash, "--ftti", "10ms")
    (line,) = [line for line in out.splitlines() if line.startswith("  handled    ")]
    assert code == 0 and re.search(
        r": operational, FHTI 0\.\d+ ms, at most 2\.936 \(FDTI 0\.\d+, FRTI 0", line
    )
    code, out, _ = sim(*crash, "--ftti", "0.1ms")
    assert code == 1 and "the FTTI is 0.1" in out
    code, out, _ = sim(*crash, "--ftti", "0.1ms", "--json")
    found = json.loads(out)
    (interval,) = found["intervals"]
    assert (found["verdict"], interval["reaction"], interval["latent"]) == ("fail", "operational", False)
    assert interval["fdti_ms"] + interval["frti_ms"] == pytest.approx(interval["fhti_ms"], abs=0.002)


def test_without_a_request_behind_the_fault_an_ftti_is_not_known(sim: Call) -> None:
    code, out, _ = sim("--count", "20", "--inject", "crash primary after 60ms", "--ftti", "10ms")
    assert code == 3 and "ftti: crash primary after 60ms: no request came after it" in out


def test_the_same_seed_prints_the_same(sim: Call) -> None:
    arguments = ("--seed", "3", "--count", "20", "--rate", "900", "--inject", "crash backup after 4ms")
    first, second = (re.sub(r" in [0-9.]+ ms", "", sim(*arguments)[1]) for _ in range(2))
    assert first == second


def test_an_adaptation_is_told_once_as_in_a_real_run(sim: Call) -> None:
    words = ("--ftm", "lfr", "--count", "30", "--rate", "500", "--adapt", "compose lfr+tr at request 5")
    code, out, _ = sim(*words)
    assert code == 0
    told = [line for line in out.splitlines() if ": done" in line and not line.startswith("[")]
    assert len(told) == 1, told
    assert re.match(r"  adaptation to lfr\+tr at request 5: done, blackout [0-2]\.\d\d ms, total ", told[0])
    assert "  at the end lfr+tr" in out.splitlines()
    document = json.loads(sim(*words, "--json")[1])
    (adaptation,) = document["adaptations"]
    assert set(adaptation) == set(AskedAdaptation.__struct_fields__)
    assert (adaptation["asked"], adaptation["outcome"]) == ("to lfr+tr at request 5", "done")
    assert 0 < adaptation["blackout_ms"] < 3 and document["ftm_at_end"] == "lfr+tr"
    assert document["verdict"] == "pass" and document["requests"]["answered"] == 30


OTHER_FUNCTION: Final = """
from aftbed.core.application import Characteristics
class Adder:
    characteristics = Characteristics()
    def __init__(self): self.sum = 0
    def execute(self, request):
        self.sum += len(request) * STEP
        return b"%d" % self.sum
    def capture(self): return b"%d" % self.sum
    def restore(self, state): self.sum = int(state)
"""


def test_a_function_of_the_user_is_simulated_updated_and_judged(sim: Call, tmp_path: Path) -> None:
    for step in (1, 2):
        (tmp_path / f"adder{step}.py").write_text(OTHER_FUNCTION.replace("STEP", str(step)))
    update = ("--adapt", f"update app to {tmp_path}/adder2.py:Adder at request 20")
    crash = ("--inject", "crash primary at server.exit nth 9")
    code, out, _ = sim("--app", tmp_path / "adder1.py:Adder", "--count", "40", *update, *crash)
    assert code == 0, out
    assert f"seed 0, 40 requests; {tmp_path}/adder1.py:Adder; crash primary" in out
    assert "  requests   40 sent, 40 answered, 0 lost, 0 duplicated, 0 late, 0 wrong" in out
    assert f"  adaptation update app to {tmp_path}/adder2.py:Adder at request 20: done" in out


def test_an_update_that_the_function_cannot_follow_is_undone_and_says_why(sim: Call, tmp_path: Path) -> None:
    """One that refuses all requests would answer them all, and do nothing."""
    adder = OTHER_FUNCTION.replace("STEP", "1")
    (tmp_path / "adder.py").write_text(adder)
    known, first = "from aftbed.core.errors import PeerError\n", "raise PeerError('not mine')"
    restoring = f"def restore(self, state):\n        if not self.sum: {first}\n        self.sum ="
    (tmp_path / "other.py").write_text(
        known + adder.replace("def restore(self, state): self.sum =", restoring)
    )
    (tmp_path / "refusing.py").write_text(known + adder.replace("self.sum += ", f"{first}; "))
    for name, told in (
        ("other", "rolled back: {0}/other.py:Adder takes no state of {0}/adder.py:Adder: a/server': "),
        ("refusing", "refused: a/server': self-test: {0}/refusing.py:Adder refuses each of the 16 requests"),
    ):
        update = ("--adapt", f"update app to {tmp_path}/{name}.py:Adder at request 20", "--may-fail")
        code, out, err = sim("--app", tmp_path / "adder.py:Adder", "--count", "40", *update)
        assert code == 0, out + err
        assert (
            told.format(tmp_path) in out
            and "40 sent, 40 answered, 0 lost, 0 duplicated, 0 late, 0 wrong" in out
        )


def test_a_crash_right_behind_the_commit_of_an_update(sim: Call, tmp_path: Path) -> None:
    for step in (1, 2):
        (tmp_path / f"adder{step}.py").write_text(OTHER_FUNCTION.replace("STEP", str(step)))
    update = ("--adapt", f"update app to {tmp_path}/adder2.py:Adder at request 10", "--may-fail")
    words = ("--app", tmp_path / "adder1.py:Adder", "--count", "30", "--rate", "300", *update)
    for role, ftm in (("primary", "pbr"), ("backup", "pbr+tr"), ("engine", "lfr")):
        code, out, _ = sim(*words, "--ftm", ftm, "--inject", f"crash {role} at adapt.commit")
        assert code == 0 and f"crash {role} at adapt.commit nth 1: activated" in out, out
        assert "30 answered, 0 lost, 0 duplicated, 0 late, 0 wrong" in out


ROUGH: Final = """
import struct
from aftbed.core.application import *
class Mean:
    characteristics = Characteristics(state_access=ACCESS)
    reply_fields = (Field("mean", "f64", 0),)
    mean = 0.0
    def execute(self, request):
        self.mean += (request[-1] / 7 - self.mean) / 10
        return struct.pack("<d", self.mean)
    def capture(self): return struct.pack("<f", self.mean)
    def restore(self, state): (self.mean,) = struct.unpack("<f", state)
"""


@pytest.mark.parametrize(
    ("access", "found"),
    [("approximate(1e-3)", "pass"), ("approximate(1e-12)", "fail"), ("EXACT", "fail")],
)
def test_replies_are_compared_within_what_the_function_declares(
    sim: Call, tmp_path: Path, access: str, found: str
) -> None:
    """Its state keeps seven digits."""
    (tmp_path / "rough.py").write_text(ROUGH.replace("ACCESS", access))
    app, crash = f"{tmp_path}/rough.py:Mean", ("--inject", "crash primary at server.exit nth 9")
    document = json.loads(sim("--app", app, "--ftm", "pbr", "--count", "12", *crash, "--json")[1])
    assert document["verdict"] == found, document["breaches"]
    assert all(one.startswith("one_history (G3): request ") for one in document["breaches"])


def test_it_is_told_that_replies_were_not_compared(sim: Call) -> None:
    code, out, _ = sim("--app", UNREPEATABLE, "--ftm", "pbr", "--count", "9")
    assert code == 0 and f"  function   {UNREPEATABLE}, its replies are not compared" in out


FAILING: Final = """
from aftbed.core.application import Characteristics
class Failing:
    characteristics = Characteristics()
    captured = 0
    def execute(self, request): return b"done"
    def capture(self):
        self.captured += 1
        if self.captured > 20: raise MemoryError("no more")
        return b"state"
    def restore(self, state): pass
"""


def test_a_function_that_fails_is_told_and_nothing_breaks_down(sim: Call, tmp_path: Path) -> None:
    """In both replicas, and when its state is asked for at the end."""
    (tmp_path / "failing.py").write_text(FAILING)
    code, out, err = sim("--app", f"{tmp_path}/failing.py:Failing", "--count", "40")
    assert code == 1 and "Traceback" not in err, err
    assert re.search(
        r"^  failed     a/server: Failing: MemoryError: no more \(.*failing.py:9, in", out, re.M
    ), out


SILENT_AT_THE_END: Final = """
from aftbed.core.application import Characteristics
class Silent:
    characteristics = Characteristics()
    executed = 0
    def execute(self, request):
        self.executed += 1
        return b"done"
    def capture(self):
        if self.executed > 35: raise MemoryError("no more")
        return b"state"
    def restore(self, state): pass
"""


def test_a_state_that_cannot_be_had_at_the_end_is_no_pass(sim: Call, tmp_path: Path) -> None:
    """Under LFR it is asked for only then."""
    (tmp_path / "silent.py").write_text(SILENT_AT_THE_END)
    code, out, err = sim("--app", f"{tmp_path}/silent.py:Silent", "--ftm", "lfr", "--count", "40")
    assert code == 3 and "Traceback" not in err, out + err
    assert "the bare function fails at request 40: Silent: MemoryError: no more" in out


BRAKE: Final = """
import json, struct, sys
latched = False
for line in sys.stdin:
    asked = json.loads(line)
    answer = {"id": asked["id"]}
    if "describe" in asked:
        answer["describe"] = {"deterministic": True, "state_access": "exact"}
    elif "execute" in asked:
        _, t_ms, speed, known, radar, target, gap, closing = struct.unpack(
            "<BQdBBBdd", bytes.fromhex(asked["execute"])
        )
        latched |= bool(target and closing < 0 and gap < 1.6 * -closing)
        answer["execute"] = struct.pack("<d", 9.0 if latched else 0.0).hex()
    elif "capture" in asked:
        answer["capture"] = bytes([latched]).hex()
    else:
        latched, answer["restore"] = bool(bytes.fromhex(asked["restore"])[0]), None
    print(json.dumps(answer), flush=True)
"""


def test_a_program_brakes_a_car(sim: Call, tmp_path: Path) -> None:
    (tmp_path / "brake.py").write_text(BRAKE)
    app = f"{sys.executable} -I -S {tmp_path}/brake.py"
    crash = ("--inject", "crash primary when ttc < 1.5")
    code, out, _ = sim("--app", app, "--ftm", "pbr", "--scenario", "ccrs-20", *crash)
    assert code == 0 and re.search(r"^  car +stopped", out, re.MULTILINE), out
    assert "  failover   to epoch 2" in out


def test_what_a_function_says_wrong_after_a_failover_is_found(sim: Call, tmp_path: Path) -> None:
    forgetful = OTHER_FUNCTION.replace("STEP", "1").replace("self.sum = int(state)", "pass")
    (tmp_path / "adder.py").write_text(forgetful)
    app = ("--app", tmp_path / "adder.py:Adder")
    code, out, _ = sim(*app, "--count", "12", "--inject", "crash primary at server.exit nth 9")
    assert code == 1 and "one_history fail" in out
    again = next(line for line in out.splitlines() if line.startswith("  repeat "))
    assert f"--app {tmp_path}/adder.py:Adder" in again


NEEDED: Final = "crash b/before at adapt.step.enter nth 7"
ROLLED_BACK: Final = ("--adapt", "to lfr at request 5", "--inject", NEEDED)
REFUSED: Final = ("--adapt", "to pbr at request 5", "--force")


def test_a_node_that_is_never_prepared_is_told_with_the_deadline(sim: Call) -> None:
    fault = ("--inject", "hang a/after' at adapt.step.exit nth 1")
    code, out, _ = sim("--count", "40", "--rate", "50", "--adapt", "to lfr at request 5", *fault)
    assert code == 3 and "prepare: no answer within 0.5 s from a/after'\n" in out, out


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (ROLLED_BACK, "to lfr at request 5: rolled back: "),
        (REFUSED, "to pbr at request 5: refused: "),
    ],
)
def test_an_adaptation_that_was_not_done_is_inconclusive_unless_it_may_fail(
    sim: Call, words: tuple[str, ...], reason: str
) -> None:
    code, out, _ = sim("--count", "30", "--rate", "500", *words)
    assert code == 3 and f"  because    adaptations_done: {reason}" in out, out
    assert sim("--count", "30", "--rate", "500", *words, "--seeds", "0..1")[0] == 3
    code, out, _ = sim("--count", "30", "--rate", "500", *words, "--may-fail")
    assert code == 0 and f"  adaptation {reason}" in out, out
    assert sim("--count", "30", "--rate", "500", *words, "--may-fail", "--seeds", "0..1")[0] == 0


def test_a_car_stops_short(sim: Call) -> None:
    code, out, _ = sim("--scenario", "ccrs-20", "--inject", "crash primary at server.exit nth 40")
    assert code == 0
    assert re.search(r"^  car        stopped [0-9.]+ m short", out, re.MULTILINE)
    assert "vehicle pass" in out


def test_a_fault_or_adaptation_that_never_happened_is_inconclusive(sim: Call) -> None:
    fault = ("--count", "10", "--inject", "crash primary at server.exit nth 11")
    code, out, _ = sim(*fault)
    assert code == 3
    assert "never fired: crash primary at server.exit nth 11" in out and "verdict: inconclusive" in out
    code, out, _ = sim("--count", "10", "--adapt", "to lfr after 60s", "--json")
    assert code == 3
    (missed,) = json.loads(out)["missed"]
    assert re.fullmatch(
        r"adaptations_done: to lfr after 60000ms: not begun: the run ended after 0\.\d+ s", missed
    )
    code, out, _ = sim(*fault, "--seeds", "0..2")
    assert code == 3
    assert "inconclusive: in 3 runs" in out and "seed 0: faults_applied: never fired" in out


def test_a_service_is_unavailable_if_every_replica_was_struck(sim: Call) -> None:
    code, out, _ = sim("--ftm", "none", "--count", "10", "--inject", "crash primary at server.exit nth 3")
    assert code == 0 and "outcome: unavailable" in out


# -- a failure


def test_a_failure_is_shrunk_and_its_commands_repeat_it(sim: Call, call: Call) -> None:
    code, out, _ = sim("--seed", "5", *FLIP)
    assert code == 1
    assert "  because    one_history (G3): request 3: the reply is not the bare server's" in out
    assert out.splitlines()[0] == out.splitlines()[-1] == "seed 5"
    original, shrunk = re.findall(r"^  repeat +(aftbed sim .*)$", out, re.MULTILINE)
    assert "--count 10" in original and "nth 3" in original
    assert "--seed 5" in shrunk and "--count 1 " in shrunk and "nth 1" in shrunk
    for command in (original, shrunk):
        code, again, _ = call(*shlex.split(command)[1:])
        assert code == 1 and "because    value (G4): request" in again


def test_the_document_of_a_failure(sim: Call) -> None:
    code, out, _ = sim("--seed", "5", *FLIP, "--json")
    found = json.loads(out)
    assert code == 1
    assert (found["seed"], found["verdict"], found["outcome"]) == (5, "fail", "sdc")
    assert found["breaches"][0] == "one_history (G3): request 3: the reply is not the bare server's"
    assert found["command"].startswith("aftbed sim --seed 5 --ftm pbr --count 10 --inject ")
    assert "--count 1 " in found["shrunk"]


def test_a_failure_shows_its_last_messages_and_draws_them(sim: Call, tmp_path: Path) -> None:
    _, out, _ = sim(*FLIP, "--diagram", tmp_path / "last.md")
    drawn_text = out.partition("verdict: fail\n")[2].partition("found: ")[0]
    assert "pxy2pro" in drawn_text and "fault.applied: bitflip result bit 60 in primary" in drawn_text
    assert (
        "broken: one_history (G3): request 3: the reply is not the bare server's" in drawn_text.splitlines()
    )
    assert (tmp_path / "last.md").read_text().startswith("sequenceDiagram\n")


def test_a_diagram_shows_the_fault_also_as_svg(sim: Call, tmp_path: Path) -> None:
    path = tmp_path / "run.svg"
    code, _, _ = sim("--count", "60", "--inject", "crash primary at checkpoint.sent nth 3", "--diagram", path)
    assert code == 0
    title = "{http://www.w3.org/2000/svg}title"
    tips = [one.text or "" for one in ElementTree.parse(path).iter(title)]
    assert any("crash primary at checkpoint.sent nth 3" in tip for tip in tips)
    assert any("replica.promoted" in tip for tip in tips)


def test_a_diagram_of_many_is_of_the_first_that_broke(sim: Call, tmp_path: Path) -> None:
    path = tmp_path / "first.md"
    code, _, err = sim("--seeds", "0..1", "--count", "3", "--diagram", path)
    assert code == 0 and not path.exists()
    assert f"nothing broke: {path} is not written" in err
    code, _, err = sim("--seeds", "0..1", *FLIP, "--diagram", path)
    assert (code, err) == (1, "") and "sequenceDiagram" in path.read_text()


def test_an_exception_in_the_executive_is_a_failure(sim: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    def breaks_down(setup: Setup, code: Code = NO_CODE) -> None:
        raise KeyError("a/server")

    monkeypatch.setattr("aftbed.search.explore.simulate", breaks_down)
    monkeypatch.setattr("aftbed.cli.sim.broken_run", lambda *_, **__: None)
    code, out, _ = sim("--json")
    assert code == 1 and json.loads(out)["verdict"] == "fail"


def test_every_setup_of_a_swarm_has_a_command() -> None:
    for setup in map(drawn, range(100)):
        assert repeating(setup).startswith(f"aftbed sim --seed {setup.seed} --ftm {setup.ftm} "), setup


def test_what_an_engine_would_refuse_needs_force() -> None:
    same = Setup(adaptations=(Scheduled(Goal(expression="pbr"), 5),))
    assert repeating(same).endswith('--adapt "to pbr at request 5" --force')
    other = Setup(adaptations=(Scheduled(Goal(expression="lfr"), 0, 2.5),))
    assert repeating(other).endswith('--adapt "to lfr after 2.5ms"')
    may_fail = Setup(adaptations=(Scheduled(Goal(expression="lfr", may_fail=True), 5),))
    assert repeating(may_fail).endswith('--adapt "to lfr at request 5" --may-fail')


def test_times_in_a_command_are_exact_and_some_setups_have_no_command() -> None:
    early = Setup(faults=(Fault(Crash(), "primary", Trigger(after_ms=0.125)),))
    assert repeating(early).endswith('--inject "crash primary after 0.125ms"')
    assert repeating(replace(early, dooms=(Doom("a/server", 1),))) == ""


# -- many


def test_many_runs_are_counted(sim: Call) -> None:
    code, out, _ = sim("--seeds", "3..6", "--count", "5")
    lines = out.splitlines()
    assert code == 0 and lines[0] == lines[-1] == "seeds 3..6"
    assert re.fullmatch(
        r"4 of 4 survived \(0 unavailable\) in [0-9.]+ s: [0-9 ]+ runs/s, [0-9 ]+ requests/s", lines[-2]
    )


def test_the_document_of_many(sim: Call) -> None:
    code, out, _ = sim("--seeds", "0..1", *FLIP, "--json")
    found = json.loads(out)
    assert code == 1
    assert (found["seeds"], found["runs"], found["survived"], found["unavailable"]) == ([0, 1], 2, 0, 0)
    assert [broken["seed"] for broken in found["broken"]] == [0, 1]
    assert set(found["broken"][0]) == {"seed", "breaches", "command", "shrunk"}
    assert found["runs_per_second"] > 0 and found["requests_per_second"] > 0


def test_of_many_broken_runs_the_first_are_shrunk(sim: Call) -> None:
    last = SHRUNK_MAX
    broken = json.loads(sim("--seeds", f"0..{last}", *FLIP, "--json")[1])["broken"]
    assert [bool(one["shrunk"]) for one in broken] == [True] * last + [False]
    out = sim("--seeds", f"0..{last}", *FLIP)[1]
    assert len(re.findall("^found: ", out, re.MULTILINE)) == last
    assert f"{last + 1} broke in all; --json lists them" in out


def test_two_processes_find_the_same_as_one_in_the_same_order() -> None:
    setups = [Setup("lfr", seed=seed, count=1 + seed % 3) for seed in range(16)]
    alone, together = (list(each(tried, setups, jobs)) for jobs in (1, 2))
    assert alone == together
    assert [(number, setup.seed) for number, setup, _ in alone] == [(n, n) for n in range(16)]


def test_endless_setups_are_simulated_as_results_are_read() -> None:
    endless = (Setup("none", seed=seed, count=1) for seed in itertools.count())
    with closing(each(tried, endless, 2)) as found:
        assert [number for number, _, _ in itertools.islice(found, 20)] == list(range(20))


def test_minutes_simulate_from_the_seed_on(sim: Call) -> None:
    code, out, _ = sim("--seed", "4", "--minutes", "0.001", "--count", "5", "--json")
    found = json.loads(out)
    assert code == 0 and found["runs"] >= 1
    assert found["seeds"] == [4, 3 + found["runs"]]


def test_a_swarm_is_drawn_from_the_seed(sim: Call) -> None:
    _, out, _ = sim("--swarm", "--seed", "3", "--json")
    assert json.loads(out)["setup"].startswith(f"{drawn(3).ftm} ({drawn(3).placement}), seed 3, ")


def test_a_swarm_counts_what_it_drew_beside_what_happened(sim: Call) -> None:
    code, out, _ = sim("--swarm", "--seeds", "0..4")
    assert code == 0
    assert re.search(r"^faults: [0-9]+ drawn to happen: [0-9]+ activated", out, re.MULTILINE)
    assert re.search(r"^adaptations: [0-9]+ drawn to happen: [0-9]+ done", out, re.MULTILINE)
    found = json.loads(sim("--swarm", "--seeds", "0..4", "--json")[1])
    setups = [drawn(seed) for seed in range(5)]
    assert sum(group["total"] for group in found["faults"].values()) == sum(len(s.faults) for s in setups)
    adaptations = sum(group["total"] for group in found["adaptations"].values())
    assert adaptations == sum(len(s.adaptations) for s in setups)
    assert found["vacuous"] == []


def test_one_run_tells_what_became_of_what_it_drew(sim: Call) -> None:
    seed = next(s for s in range(100) if len(drawn(s).faults) == 2 and len(drawn(s).adaptations) == 1)
    _, out, _ = sim("--swarm", "--seed", str(seed))
    assert re.search(r"^faults: [12] drawn ", out, re.MULTILINE)
    assert re.search(r"^adaptations: 1 drawn ", out, re.MULTILINE)


def test_a_swarm_that_proves_too_little_is_inconclusive(sim: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("aftbed.search.tally.ENOUGH_RUNS", 5)
    monkeypatch.setattr("aftbed.search.tally.ACTIVATED_MIN", 1.1)
    code, out, _ = sim("--swarm", "--seeds", "0..3")
    assert code == 0 and "vacuous" not in out
    code, out, _ = sim("--swarm", "--seeds", "0..4")
    assert code == 3
    assert re.search(r"^vacuous: [0-9]+ of [0-9]+ faults were activated; these runs prove", out, re.MULTILINE)
    code, out, _ = sim("--swarm", "--seeds", "0..4", "--json")
    assert code == 3 and len(json.loads(out)["vacuous"]) == 1
    code, _, _ = sim("--seeds", "0..4", "--count", "5")
    assert code == 0


def test_a_broken_promise_counts_more_than_a_swarm_that_proves_too_little(
    sim: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    def breaks_down(setup: Setup, code: Code = NO_CODE) -> None:
        raise KeyError("a/server")

    monkeypatch.setattr("aftbed.search.tally.ENOUGH_RUNS", 1)
    monkeypatch.setattr("aftbed.search.explore.simulate", breaks_down)
    monkeypatch.setattr("aftbed.cli.sim.SHRUNK_MAX", 0)
    code, out, _ = sim("--swarm", "--seeds", "0..1")
    assert code == 1 and "the executive broke down: KeyError" in out


# -- real records beside their simulation

FAST: Final = RecoveryRange(20, 0.2, 0.4, 0.6)


@pytest.mark.parametrize(
    ("real", "words"),
    [
        (RecoveryRange(3, 0.5, 0.55, 3.0), ""),  # the real median lies among the simulated times
        (RecoveryRange(3, 0.3, 0.7, 3.0), ""),  # the simulated median lies among the real ones
        (RecoveryRange(3, 0.7, 0.9, 3.0), "recovery: real median 0.9 ms, simulated 0.2 to 0.6 ms"),
        (None, "only one of them has failovers"),
    ],
)
def test_times_agree_if_a_median_lies_within_the_other_range(real: RecoveryRange | None, words: str) -> None:
    assert apart(real, FAST) == ([words] if words else [])


@pytest.mark.parametrize(("why_not", "code"), [((), 0), (("not alike",), 1)])
def test_a_disagreement_is_exit_code_1(
    sim: Call, monkeypatch: pytest.MonkeyPatch, why_not: tuple[str, ...], code: int
) -> None:
    one = Agreement("pbr process", {"masked": 1}, {"masked": 20}, FAST, None, why_not)
    monkeypatch.setattr(
        "aftbed.cli.sim.against", lambda records, seeds, trust, show: [one] if seeds == 3 else []
    )
    found, out, _ = sim("--against", str(Path("there")), "--seeds", "0..2", "--json")
    assert (found, json.loads(out)["agree"]) == (code, not why_not)


# -- bad input


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--against", "/nowhere"), ("/nowhere/run.json: No such file or directory",)),
        (("--against", "/nowhere", "--ftm", "lfr"), ("--against: the experiments are the records'",)),
        (("--against", "/nowhere", "--seeds", "5..4"), ("5..4",)),
        (("--against", "/nowhere", "--trust", "/nowhere"), ("--trust /nowhere: no such directory",)),
        (("--trust", "/tmp"), ("--trust", "give --against RECORD too")),
        (("--seeds", "5..4"), ("--seeds 5..4", "no seed is in it", "as 4..5")),
        (("--seeds", "5"), ("--seeds '5'", "A..B")),
        (("--seeds", "a..b"), ("A..B", "0..99")),
        (("--seeds", "-1..4"), ("A..B",)),
        (("--seeds", "0..9999999999999999999"), ("--seeds", "9223372036854775807")),
        (("--seeds", "0..3", "--seed", "1"), ("--seeds and --seed", "stands alone")),
        (("--seeds", "0..3", "--minutes", "1"), ("--seeds and --minutes",)),
        (("--seed", "-1"), ("--seed -1", "0 to 9223372036854775807")),
        (("--minutes", "0"), ("--minutes 0.0", "more than 0")),
        (("--minutes", "nan"), ("--minutes nan",)),
        (("--count", "0"), ("--count 0", "1 to 100000")),
        (("--count", "100001"), ("--count 100001",)),
        (("--rate", "0"), ("--rate 0.0", "each follows the reply before")),
        (("--rate", "nan"), ("--rate nan",)),
        (("--count", "100000", "--rate", "1"), ("--rate 1.0", "3600 s of virtual time")),
        (("--jobs", "0"), ("--jobs 0", "1 to 256")),
        (("--ftm", "pbrr"), ("unknown FTM 'pbrr'", "did you mean 'pbr'")),
        (("--placement", "proces"), ("unknown placement", "did you mean 'process'")),
        (("--scenario", "ccrs50"), ("unknown scenario 'ccrs50'", "did you mean 'ccrs-50'")),
        (("--scenario", "ccrs-50", "--count", "5"), ("the car makes the requests", "--count")),
        (("--swarm", "--ftm", "pbr"), ("--swarm draws everything", "leave out --ftm")),
        (("--swarm", "--count", "3", "--force"), ("leave out --count, --force",)),
        (("--inject", "crash a/servr"), ("unknown target 'a/servr'", "did you mean 'a/server'")),
        (("--ftm", "none", "--inject", "crash backup"), ("unknown target 'backup'",)),
        (("--inject", "crash zygote"), ("the simulator has no zygote",)),
        (("--inject", "crash primary after 9999999s"), ("duration '9999999s'",)),
        (("--inject", "crash primary at server.exitt"), ("did you mean 'server.exit'",)),
        (
            ("--ftm", "none", "--inject", "crash primary at checkpoint.sent"),
            ("cannot trigger a fault under --ftm none",),
        ),
        (("--adapt", "to lfrr"), ("--adapt 'to lfrr'", "did you mean 'lfr'")),
        (("--adapt", "to lfr at request 101"), ("there are 100 requests",)),
        (("--adapt", "update before to none.py:Mine"), ("none.py: no such file",)),
        (("--app", "none.py:Mine"), ("none.py: no such file",)),
        (("--app", UNREPEATABLE, "--ftm", "lfr"), ("lfr needs a deterministic function", "--force does it")),
        (("--swarm", "--app", UNREPEATABLE), ("leave out --app",)),
        (("--adapt", "decompose", "--force"), ("to EXPR",)),
        (("--adapt", "to lfr", "--recipe", "papr"), ("unknown recipe 'papr'",)),
        (("--force",), ("--force is about --adapt and --app",)),
        (("--diagram", "/nowhere/at/all.md"), ("--diagram /nowhere/at/all.md", "a directory that exists")),
    ],
)
def test_options_that_are_refused(
    refused: Output, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    error = refused("sim", *arguments)
    assert all(word in error for word in words), error


def test_a_replica_is_struck_too_where_its_exchanged_process_dies(sim: Call) -> None:
    """Behind an exchange the new process of one replica dies, and the old one of the other."""
    at = "at adapt.step.act nth 8"
    faults = ("--inject", f"crash b' {at}", "--inject", f"crash primary {at}")
    run = ("--seed", "6496", "--ftm", "pbr", "--placement", "replica", "--count", "1")
    code, out, _ = sim(*run, *faults, "--adapt", "to lfr+tr at request 1")
    assert code == 3 and "exactly_one_answer pass" in out, out


@pytest.mark.parametrize("placement", ["process", "single"])
def test_a_stop_by_supervision_that_a_fault_has_caused_is_no_loss_without_a_cause(
    sim: Call, placement: str
) -> None:
    slow = ("--inject", "slow primary by 30ms at server.enter nth 10", "--count", "40")
    code, out, _ = sim("--ftm", "sup", "--placement", placement, *slow)
    assert code == 0 and "outcome: unavailable" in out and "exactly_one_answer unknown" in out, out
    twice = ("--inject", "duplicate pro2bfr nth 5", "--count", "40")  # it stops both: nothing excuses that
    code, out, _ = sim("--ftm", "lfr+sup", *twice)
    assert code == 1 and "the service is lost, though no node was struck" in out, out
