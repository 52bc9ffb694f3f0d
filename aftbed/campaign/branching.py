"""One drive, copied at many instants: what a fault would do at each of them, for less than a run each.

The process that simulates is copied (`fork`) shortly before the fault is to strike. The copy strikes,
drives on until it is decided, and says what came of it; the original drives on to the next instant. So no
copy repeats what lies before its fault, and none drives on when all is over: half of the time for a table
whose cars ahead stand or move, more where they move.

In a copy the fault is armed when the drive has begun, so chance (the delays of hops, microseconds each) is
drawn in another order than in a run with the same fault from its start. The two can differ by a step of
the brakes: whoever tells a result takes it from a whole run.
"""

import gc
import os
import select
import signal
import sys
import traceback
from collections.abc import Iterable, Iterator
from typing import Final

import msgspec

from aftbed.campaign.course import Course
from aftbed.core.errors import HarnessError
from aftbed.core.fault import FIRED, Fault
from aftbed.runtime.sim.world import World
from aftbed.runtime.unix import linux
from aftbed.vehicle.plant import VehicleResult

LOOK_NS: Final = 100_000_000  # of virtual time, between two looks at whether it is decided
DECIDED_SECONDS_MAX: Final = 60.0  # a drive takes a tenth of a second


class Branch(msgspec.Struct, frozen=True):
    """`fault`, armed at `at_ms` of bus time."""

    at_ms: float
    fault: Fault


class Outcome(msgspec.Struct, frozen=True):
    """What came of it."""

    result: VehicleResult
    fired: bool


def branched(course: Course, branches: Iterable[Branch], over_ms: float) -> Iterator[Outcome]:
    """The outcome of each, at `over_ms` of bus time or before; the earliest comes first.

    Raises HarnessError if a copy dies, or does not come to an end.
    """
    world = World(course.setup)
    world.start()
    last_ns = course.began_ns + round(min(over_ms, float(course.cycles[-1].t_ms)) * 1e6)
    for branch in branches:
        world.advance(course.began_ns + round(branch.at_ms * 1e6))
        yield _branch(world, branch.fault, last_ns)


def _branch(world: World, fault: Fault, last_ns: int) -> Outcome:
    """In a copy of this process, which dies with it."""
    reader, writer = os.pipe()
    parent, pid = os.getpid(), os.fork()
    if pid == 0:
        try:
            linux.die_with(parent)
            gc.disable()  # it would only copy pages
            os.write(writer, msgspec.msgpack.encode(_decided(world, fault, last_ns)))
        except BaseException:  # noqa: BLE001 - the last frame of this process
            traceback.print_exc()
            sys.stderr.flush()
        finally:
            os._exit(0)
    os.close(writer)
    poll = select.poll()
    poll.register(reader, select.POLLIN)
    late = not poll.poll(DECIDED_SECONDS_MAX * 1e3)
    if late:
        os.kill(pid, signal.SIGKILL)  # ours, and not reaped yet: so this pid is nobody else's
    with open(reader, "rb") as file:
        said = file.read()
    os.waitpid(pid, 0)
    if not said:
        what = f"is not decided after {DECIDED_SECONDS_MAX:g} s" if late else "died"
        raise HarnessError(f"{fault}: the copy of the simulator {what}, {world.setup.scenario}")
    return msgspec.msgpack.decode(said, type=Outcome)


def _decided(world: World, fault: Fault, last_ns: int) -> Outcome:
    """Strike, and drive on until nothing can become worse: in contact, at rest, or at the end."""
    world.inject(fault)
    until_ns = world.loop.ns
    while True:
        until_ns += LOOK_NS
        world.advance(until_ns)
        found = world.outcome()
        result = found.vehicle
        assert result is not None, "a course has a car"
        if result.collision or result.stop_gap_m is not None or until_ns > last_ns:
            return Outcome(result, all(told["receipt"] in FIRED for told in found.faults))
