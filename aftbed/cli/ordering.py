"""What `aftbed explore order` does: every order of arrival in a few experiments, up to a bound, counted."""

import time
from typing import Final

import msgspec

from aftbed.cli.exploring import REQUESTS_MAX, Asked
from aftbed.cli.simasked import jobs_of
from aftbed.cli.simview import Bar, described, spaced
from aftbed.core.errors import ConfigError
from aftbed.judge.verdict import EXIT_CODES
from aftbed.search.explore import Ordered, experiments, explore_orders, selected

BOUND_MAX: Final = 10_000_000


def run(asked: Asked, bound: int, *, as_json: bool) -> int:
    """Explore, show, count; the exit code."""
    jobs = jobs_of(asked.jobs)
    assert asked.requests is not None
    for name, value, most in (("--requests", asked.requests, REQUESTS_MAX), ("--bound", bound, BOUND_MAX)):
        if not 1 <= value <= most:
            raise ConfigError(f"{name} {value}: 1 to {most} are allowed")
    chosen = selected("crash", asked.ftms, asked.placements, asked.requests)  # the same mechanisms
    setups = list(experiments(chosen.ftms, chosen.placements, asked.requests))
    began_s, found = time.monotonic(), list[Ordered]()
    with Bar("explore order", len(setups), quiet=as_json) as bar:
        for one in explore_orders(setups, bound, jobs):
            found.append(one)
            bar.show(len(found), len(found), sum(bool(o.broken) for o in found))
            if not as_json:
                print(_line(one), flush=True)
    _tell(found, bound, round(time.monotonic() - began_s, 3), as_json=as_json)
    return EXIT_CODES["fail" if any(one.broken for one in found) else "pass"]


def _line(one: Ordered) -> str:
    """One experiment."""
    whole = "all" if one.complete else "at least"
    lines = [f"{whole} {spaced(one.orders)} orders ({spaced(one.cut)} cut): {described(one.setup)}"]
    lines += [f"  broken in {spaced(one.broken)}: {reason}" for reason in one.breaches]
    return "\n".join(lines)


def _tell(found: list[Ordered], bound: int, seconds: float, *, as_json: bool) -> None:
    """The count."""
    orders, broken = sum(o.orders for o in found), sum(o.broken for o in found)
    complete = sum(o.complete for o in found)
    if as_json:
        document = {
            "explored": orders,
            "survived": orders - broken,
            "experiments": len(found),
            "complete": complete,
            "bound": bound,
            "seconds": seconds,
            "broken": [
                {"setup": described(o.setup), "orders": o.broken, "breaches": o.breaches}
                for o in found
                if o.broken
            ],
        }
        print(msgspec.json.encode(document).decode())
        return
    print(
        f"{spaced(orders - broken)} of {spaced(orders)} orders survived; all orders of {complete} of"
        f" {len(found)} experiments, the others up to {spaced(bound)} runs each; {seconds:.1f} s"
    )
