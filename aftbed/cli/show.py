"""A verdict for people, or as the one document of `--json`."""

import msgspec

from aftbed.judge.verdict import Verdict
from aftbed.runtime.unix.closedloop import proposed_line


def show_verdict(verdict: Verdict, *, as_json: bool) -> None:
    """Print it to standard output."""
    if as_json:
        print(msgspec.json.encode(verdict).decode())
        return
    requests = verdict.requests
    print(f"{verdict.scenario} under {verdict.ftm} ({verdict.placement}), seed {verdict.seed}")
    print(
        f"  requests   {requests.sent} sent, {requests.answered} answered, {requests.lost} lost,"
        f" {requests.duplicated} duplicated, {requests.late} late, {requests.wrong} wrong"
    )
    _show_vehicle(verdict)
    for f in verdict.failovers:
        print(
            f"  failover   to epoch {f.epoch}: detected {_ms(f.detected_ms)}, fenced {_ms(f.fenced_ms)},"
            f" promoted {_ms(f.promoted_ms)}, next good reply {_ms(f.recovered_ms)},"
            f" blackout {_ms(f.blackout_ms)}"
        )
    for proposal in verdict.proposals or ():
        print(f"  proposal   {proposed_line(proposal)}")
    for fault in verdict.faults:
        print(f"  fault      {fault['fault']}: {fault['receipt']}")
    print("  checks     " + ", ".join(f"{name} {found}" for name, found in verdict.checks.items()))
    for reason in verdict.reasons:
        print(f"  because    {reason}")
    print(f"verdict: {verdict.verdict}")


def _show_vehicle(verdict: Verdict) -> None:
    car = verdict.vehicle
    if car is None:
        if verdict.replay is not None:
            print(f"  replay     {msgspec.json.encode(verdict.replay).decode()}")
        return
    if car.collision:
        print(f"  car        COLLISION at {car.impact_speed_kmh:.1f} km/h")
    elif car.stop_gap_m is not None:
        print(
            f"  car        stopped {car.stop_gap_m:.2f} m short, {car.max_deceleration_ms2:.1f} m/s2 at most"
        )
    else:
        braked = "braked" if car.braked else "never braked"
        print(
            f"  car        {braked}"
            + ("" if car.min_gap_m is None else f", gap {car.min_gap_m:.2f} m at least")
        )


def _ms(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f} ms"
