"""Whether a node is alive, seen from outside: by a Watchdog of its replica, and by the supervisor.

A node that has nothing to do does not have to show that it lives, so it sleeps. Its host writes one byte into
the header of its journal, the *activity*: even while the host waits for mail or orders, odd while it executes
bricks, and another value each time (`UnixIO`). A watcher looks at that byte, and asks the kernel:

| activity           | state (proc(5))         | the node                                                |
|--------------------|-------------------------|---------------------------------------------------------|
| has changed        | `S`, `R`, `D`           | is alive                                                |
| the same, waits    | `S`, asleep             | is alive                                                |
| the same, executes | `S`                     | hangs: blocked in a brick; or starves, see `Starvation` |
| the same           | `R`, `D`                | hangs: it loops; or starves, see `Starvation`           |
| any                | `T`, stopped; `Z`, dead | hangs                                                   |

It hangs from the last look that saw it alive, but at most `LOOK_NS` before the first one that did not: a
watcher that looks less often notices a hang later, and not a shorter one.
"""

import os
from pathlib import Path
from typing import Final

from aftbed.runtime.devices import LOOK_NS
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.death_notice import FUTEX_OWNER_DIED
from aftbed.runtime.unix.journal_files import JournalHeader

EXCUSED_NS_MAX: Final = 2_000_000_000  # as long as any step of the runtime may take
STILL_NS: Final = LOOK_NS * 3 // 2  # two looks; CPU time grows with each tick, which takes 10 ms at most
RUNNING: Final = ("S", "R", "D")  # neither stopped nor dead
_STATE_BYTES: Final = 128  # of /proc/PID/stat: the pid, a name of at most 16 bytes, the state


class Starvation:
    """Distinguishes a process that hangs from one that the machine does not let run (proc(5)).

    | state                  | its CPU time since it was first asked for | verdict                   |
    |------------------------|-------------------------------------------|---------------------------|
    | `T`, `t`, `Z`, `X`     | any                                       | hangs                     |
    | `R`, runnable          | at most half of the time                  | starves                   |
    | `R`                    | more, but none for `STILL_NS`             | starves: its core stands  |
    |                        |                                           | still                     |
    | `R`                    | more                                      | hangs: it loops           |
    | `D`, waits for a disk  | at most half of the time                  | starves                   |
    | `S`, asleep            | for a quarter of the time it was ready to | starves: it gets too      |
    |                        | run and not let run                       | little, and too late      |
    | `S`, and a child, as a | as above, of the child                    | starves: it waits for the |
    | program, starves       |                                           | child                     |
    | `S`                    | else                                      | hangs: blocked in a brick |

    No excuse lasts longer than `EXCUSED_NS_MAX`. The time for which a virtual core stood still may be counted
    as CPU time of the process on it, all at once when it goes on; so the sum alone does not show a loop.
    """

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._since_ns, self._cpu_ns, self._waited_ns = 0, 0, 0
        self._grew_ns, self._last_cpu_ns = 0, 0  # when its CPU time was last found to have grown, and to what
        self._children: list[Starvation] = []
        self._stat = _open(pid)

    def forget(self) -> None:
        """Reset: the process has been seen alive."""
        self._since_ns = 0
        while self._children:
            self._children.pop().close()

    def state(self) -> str:
        """The state letter; `""` of a process that is gone."""
        if self._stat < 0:
            return ""
        try:
            stat = os.pread(self._stat, _STATE_BYTES, 0)
        except ProcessLookupError:
            return ""
        at = stat.rfind(b")") + 2
        return stat[at : at + 1].decode()

    def starves(self, now_ns: int, state: str = "") -> bool:
        """Whether the process, which is not seen alive, is one that the machine does not let run.

        The first call begins the comparison: it is False.
        """
        state = state or self.state()
        try:
            cpu_ns, waited_ns = map(int, linux.proc_text(self._pid, "schedstat").split()[:2])
        except (OSError, ValueError, IndexError):
            return False
        if self._since_ns == 0:
            self._since_ns, self._cpu_ns, self._waited_ns = now_ns, cpu_ns, waited_ns
            self._last_cpu_ns = -1
            self._children = [Starvation(child) for child in _children(self._pid)]
        if cpu_ns != self._last_cpu_ns:
            self._last_cpu_ns, self._grew_ns = cpu_ns, now_ns
        of_children = [child.starves(now_ns) for child in self._children]
        ran_ns, passed_ns = cpu_ns - self._cpu_ns, now_ns - self._since_ns
        if not 0 < passed_ns <= EXCUSED_NS_MAX:
            return False
        match state:
            case "R" | "D":
                return 2 * ran_ns <= passed_ns or now_ns - self._grew_ns >= STILL_NS
            case "S":
                return 4 * (waited_ns - self._waited_ns) > passed_ns or any(of_children)
            case _:
                return False

    def close(self) -> None:
        """Let go of all descriptors."""
        self.forget()
        if self._stat >= 0:
            os.close(self._stat)
            self._stat = -1


class Liveness:
    """Of one node, in the eyes of one watcher, which looks now and then."""

    def __init__(self, pid: int, journal: Path | str) -> None:
        self.header = JournalHeader(journal)
        self._starvation = Starvation(pid)
        self._activity, self._seen_ns = -1, 0
        self._seen = True  # by the last look; there is none yet of a process that has just answered
        self.idle = False  # as the last look found it: it waits, and has done nothing since the one before

    def seen_ns(self, now_ns: int) -> int:
        """Look: when the node was last seen alive. Now, if the machine does not let it run; see the table."""
        before, self._activity = self._activity, self.header.activity()
        state, changed = self._starvation.state(), self._activity != before
        self.idle = not changed and state == "S" and not before & 1
        if self.idle or (changed and state in RUNNING):
            if not self._seen:
                self._starvation.forget()
                self._seen = True
            self._seen_ns = now_ns
        elif self._starvation.starves(now_ns, state):
            self._seen_ns, self._seen = now_ns, False
        elif self._seen:
            self._seen_ns, self._seen = max(self._seen_ns, now_ns - LOOK_NS), False
        return self._seen_ns

    def dying(self) -> bool:
        """Whether it is dead, or the kernel has begun to end it, which a pidfd does not show yet."""
        return bool(self.header.lifeline() & FUTEX_OWNER_DIED) or self._starvation.state() in ("", "X", "Z")

    def close(self) -> None:
        """Let go of the journal and the process."""
        self.header.close()
        self._starvation.close()


def _children(pid: int) -> list[int]:
    """The processes that the main thread of `pid` has started; none where the kernel does not tell."""
    try:
        return [int(child) for child in linux.proc_text(pid, f"task/{pid}/children").split()]
    except (OSError, ValueError):
        return []


def _open(pid: int) -> int:
    """A descriptor of /proc/PID/stat, which stays that process's; -1 of one that is gone."""
    try:
        return os.open(f"/proc/{pid}/stat", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return -1
