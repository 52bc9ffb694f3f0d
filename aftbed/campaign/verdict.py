"""The verdict over one run: every promise checked, and honest about what it does not know (G8).

Trouble of the harness, a history that is not whole, a fault that never fired: none of them is a pass.
"""

from typing import Final, Literal

import msgspec

from aftbed.campaign.record import RunRecord
from aftbed.campaign.succession import bare_server
from aftbed.campaign.value import value
from aftbed.campaign.wholeness import half_a_graph
from aftbed.core import check
from aftbed.core.check import Check, Failover, Requests
from aftbed.core.fault import FIRED
from aftbed.runtime.hosting import Hosted
from aftbed.runtime.unix.closedloop import Proposed, read_proposals
from aftbed.runtime.unix.options import COMMAND_GONE, CarRun, ReplayRun
from aftbed.vehicle.plant import VehicleResult
from aftbed.vehicle.scenarios.library import load_scenario
from aftbed.vehicle.scenarios.scenario import broken_expectations

Word = Literal["pass", "fail", "inconclusive"]
EXIT_CODES: Final[dict[Word, int]] = {"pass": 0, "fail": 1, "inconclusive": 3}
EXIT_INTERRUPTED: Final = 130
STOPPED: Final = ("", "interrupted", "stopped")  # ends that somebody wanted


class Verdict(msgspec.Struct, frozen=True):
    """The one document of `aftbed run --json`."""

    run: str
    seed: int
    ftm: str
    placement: str
    scenario: str
    verdict: Word
    requests: Requests
    vehicle: VehicleResult | None
    failovers: list[Failover]
    checks: dict[str, str]
    reasons: list[str]
    faults: list[dict[str, str]]
    replay: dict[str, object] | None
    seconds: float | None
    launch_ms: float | None
    proposals: list[Proposed] | msgspec.UnsetType = msgspec.UNSET  # where there is a policy


def judge(record: RunRecord) -> Verdict:
    """Check everything that the record allows to check."""
    options, history, bare = record.options, record.history, bare_server(record)
    checks = {
        "at_most_once": check.at_most_once(history),
        "exactly_one_answer": check.exactly_one_answer(history, cut_off=_cut_off(record)),
        "one_history": check.one_history(history, bare()),
        "one_master": check.one_master(history),
        "whole_graph": _whole_graph(record),
        "clean_exit": _clean_exit(record),
        "faults_applied": _faults_applied(record),
        "whole_history": _whole(record),
    }
    values = value(history, bare(), _faults(record))
    if values is not None:
        checks["value"] = values
    vehicle = _vehicle(record)
    scenario = "load"
    if isinstance(options.work, CarRun):
        scenario = options.work.scenario
        checks["vehicle"] = _vehicle_check(record, vehicle)
    replay = None
    if isinstance(options.work, ReplayRun):
        scenario, replay = f"replay {options.work.log}", _result(record)
    proposals = read_proposals(record.path)
    sent = [e.t_ns for e in history.dialogue]
    return Verdict(
        run=options.run,
        seed=options.seed,
        ftm=options.ftm,
        placement=options.placement,
        scenario=scenario,
        verdict=_word(checks),
        requests=check.requests(history, bare()),
        vehicle=vehicle,
        failovers=check.failovers(history),
        checks={name: c.finding for name, c in checks.items()},
        reasons=[f"{name}: {reason}" for name, c in checks.items() for reason in c.reasons],
        faults=_faults(record),
        replay=replay,
        seconds=_number(record, "seconds"),
        launch_ms=round((min(sent) - record.started_ns) / 1e6, 3) if sent else None,
        proposals=msgspec.UNSET if proposals is None else proposals,
    )


def _word(checks: dict[str, Check]) -> Word:
    findings = {c.finding for c in checks.values()}
    if "fail" in findings:
        return "fail"
    return "inconclusive" if "unknown" in findings else "pass"


def _whole(record: RunRecord) -> Check:
    """A journal that was full has not seen everything."""
    lost = record.history.dropped
    return Check("unknown", (f"{lost} records found no room in the journals",)) if lost else Check("pass")


def _cut_off(record: RunRecord) -> bool:
    """Whether it ended with no regard to who waits for an answer."""
    return record.end is None or record.end.get("reason") == COMMAND_GONE


def _clean_exit(record: RunRecord) -> Check:
    """G7, as far as the supervisor saw it; a run without its end is trouble of the harness."""
    if record.end is None:
        return Check("unknown", ("the supervisor did not live to end the run",))
    left, reason = record.end.get("left"), str(record.end.get("reason"))
    if left:
        return Check("fail", (f"left behind: {left}",))
    if reason not in STOPPED:
        return Check("unknown", (reason,))
    return Check("pass")


def _whole_graph(record: RunRecord) -> Check:
    """G5, of a run that ended with somebody who leads and nothing under way."""
    if record.end is None or "hosted" not in record.end:
        return Check("unknown", ("the supervisor did not live to say what lived",))
    living = msgspec.convert(record.end["hosted"], Hosted)
    if not living.leader or record.end.get("lost"):
        return Check("pass")  # there is no service left; what that means, the other checks say
    under_way = record.end.get("unfinished")
    if under_way:
        return Check("unknown", (f"the run ended while this was under way: {under_way}",))
    done = [str(a["ftm"]) for a in record.adaptations if a["outcome"] == "done"]
    reasons = half_a_graph(living, done[-1] if done else record.options.ftm)
    return Check("fail" if reasons else "pass", tuple(reasons[: check.REASONS_MAX]))


def _faults(record: RunRecord) -> list[dict[str, str]]:
    if record.end is not None:
        return msgspec.convert(record.end.get("faults", []), list[dict[str, str]])
    return [{"fault": str(f), "receipt": "unknown"} for f in record.options.faults]


def _faults_applied(record: RunRecord) -> Check:
    """G8: a fault that did not fire proves nothing."""
    missing = [f for f in _faults(record) if f["receipt"] not in FIRED]
    return Check("unknown" if missing else "pass", tuple(map(_missed, missing)))


def _missed(fault: dict[str, str]) -> str:
    detail = fault.get("detail")
    return f"{fault['receipt']}: {fault['fault']}: {detail}" if detail else f"never fired: {fault['fault']}"


def _result(record: RunRecord) -> dict[str, object] | None:
    found = record.end.get("result") if record.end is not None else None
    return found if isinstance(found, dict) else None


def _vehicle(record: RunRecord) -> VehicleResult | None:
    found = _result(record)
    if found is None or not isinstance(record.options.work, CarRun):
        return None
    return msgspec.convert(found["result"], VehicleResult)


def _vehicle_check(record: RunRecord, vehicle: VehicleResult | None) -> Check:
    """What the scenario expects of the car; a drive that was broken off is judged by what it did."""
    assert isinstance(record.options.work, CarRun)
    found = _result(record)
    if vehicle is None or found is None:
        return Check("unknown", ("the car did not report",))
    if found.get("end") == "stopped" and not vehicle.collision:
        return Check("pass")
    broken = broken_expectations(load_scenario(record.options.work.scenario), vehicle)
    return Check("fail" if broken else "pass", tuple(broken))


def _number(record: RunRecord, key: str) -> float | None:
    found = record.end.get(key) if record.end is not None else None
    return float(found) if isinstance(found, int | float) else None
