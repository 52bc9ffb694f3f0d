"""What this machine lacks for a run: each check says what it is for and what to do.

`missing` is what a run cannot do without; `warning` is what makes it slower, what makes its figures
worse, or what only some commands need. A check tries the thing itself if that does no harm, and reads
no version numbers: a kernel has many calls that its sandbox refuses.
"""

import ctypes
import errno
import importlib.metadata
import mmap
import os
import platform
import re
import resource
import shutil
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, Literal

import msgspec

from aftbed.core.errors import ConfigError, HarnessError
from aftbed.runtime.unix import run_directory
from aftbed.runtime.unix.death_notice import SYS_FUTEX_WAITV
from aftbed.runtime.unix.launch import FILES_MIN
from aftbed.runtime.unix.linux import FILES_GOOD
from aftbed.runtime.unix.process_memory import YAMA, try_on_a_child

Status = Literal["ok", "warning", "missing"]

PROCESSES_MIN: Final = 64
FREE_BYTES_MIN, FREE_BYTES_GOOD = 50_000_000, 500_000_000  # a run of some minutes takes some MB
STEAL_SECONDS: Final = 0.2
STEAL_MAX: Final = 0.01
STEAL: Final = 7  # the field of the line `cpu` in /proc/stat
PR_GET_PDEATHSIG: Final = 2
SANDBOX: Final = "Linux 5.4 or later, and a sandbox (container, seccomp) that allows it"
OPTIONAL: Final = {  # what some commands use if it is installed
    "scipy": "exact intervals of a campaign's statistics",
    "jinja2": "the HTML report of a campaign",
    "pyarrow": "export of a campaign's records as Parquet",
    "distributed": "campaigns on many machines (Dask)",
}
BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome", "chrome")

_libc: Final = ctypes.CDLL(None, use_errno=True)


class HostCheck(msgspec.Struct, frozen=True):
    """What was found, what it is for, and what to do unless it is `ok`."""

    name: str
    status: Status
    found: str
    serves: str
    remedy: str = ""


def inspect() -> list[HostCheck]:
    """Every check, in the order in which a run needs them."""
    return [*_kernel(), *_limits(), *_place(), *_python(), *_extras(), _foreign_memory(), *_measuring()]


def _check(name: str, status: Status, found: str, serves: str, remedy: str) -> HostCheck:
    return HostCheck(name, status, found, serves, "" if status == "ok" else remedy)


def _graded(value: float, minimum: float, good: float) -> Status:
    return "missing" if value < minimum else "warning" if value < good else "ok"


# -- the kernel -----------------------------------------------------------------------------------


def _kernel() -> Iterator[HostCheck]:
    """System calls without which there is no run, and those without which it is slower."""
    yield _tried("pidfd", "deaths are seen; a signal reaches the process that was meant", SANDBOX, _pidfd)
    yield _tried("memfd", "states above a packet travel; the mark of a run", SANDBOX, _memfd)
    yield _tried("parent death signal", "no process outlives its run (G7)", SANDBOX, _parent_death_signal)
    yield _tried("packet sockets", "the channels between bricks", SANDBOX, _packets)
    yield _tried("loopback", "the CAN bus between processes", "bring the interface lo up", _loopback)
    yield _tried("/proc", "hangs, stops and leftovers are seen", "mount proc(5) at /proc", _process_files)
    ctypes.set_errno(0)
    _libc.syscall(SYS_FUTEX_WAITV, None, 0, 0, None, 0)  # nothing to wait for: EINVAL where it exists
    there = ctypes.get_errno() != errno.ENOSYS
    yield _check(
        "futex_waitv",
        "ok" if there else "warning",
        "works" if there else "the kernel has none",
        "a death is seen half a millisecond earlier",
        "Linux 5.16 or later",
    )


def _tried(name: str, serves: str, remedy: str, call: Callable[[], object]) -> HostCheck:
    """Missing if the kernel refuses `call`."""
    try:
        call()
    except (OSError, AttributeError, HarnessError) as error:
        return HostCheck(name, "missing", str(error), serves, remedy)
    return HostCheck(name, "ok", "works", serves)


def _pidfd() -> None:
    descriptor = os.pidfd_open(os.getpid())
    try:
        signal.pidfd_send_signal(descriptor, 0)
    finally:
        os.close(descriptor)


def _memfd() -> None:
    descriptor = os.memfd_create("aftbed-doctor")
    try:
        os.ftruncate(descriptor, mmap.PAGESIZE)
        mmap.mmap(descriptor, mmap.PAGESIZE).close()
    finally:
        os.close(descriptor)


def _parent_death_signal() -> None:
    found = ctypes.c_int()
    if _libc.prctl(PR_GET_PDEATHSIG, ctypes.byref(found), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _packets() -> None:
    for end in socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET):
        end.close()


def _loopback() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.listen()


def _process_files() -> None:
    Path("/proc/self/stat").read_bytes()
    Path("/proc/self/environ").read_bytes()
    os.listdir("/proc/self/fd")  # noqa: PTH208 - its names are all that is wanted


# -- limits ---------------------------------------------------------------------------------------


def _limits() -> Iterator[HostCheck]:
    """CPUs, descriptors, processes."""
    count = len(os.sched_getaffinity(0))
    remedy = "give it two: on one, the replicas wait for each other, and figures mean little"
    found = f"{count} usable of {os.cpu_count()}"
    yield _check("CPUs", "ok" if count > 1 else "warning", found, "a core for each replica", remedy)

    serves = "a replica's chain stays on its core"
    try:
        os.sched_setaffinity(0, os.sched_getaffinity(0))
    except OSError as error:
        yield HostCheck("pinning", "missing", str(error), serves, "allow sched_setaffinity(2)")
    else:
        yield HostCheck("pinning", "ok", "allowed", serves)

    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)  # a run raises its soft limit
    status = "ok" if hard == resource.RLIM_INFINITY else _graded(hard, FILES_MIN, FILES_GOOD)
    found = "unlimited" if hard == resource.RLIM_INFINITY else f"{hard} allowed"
    serves, remedy = "the supervisor holds all channels", f"ulimit -n {FILES_GOOD}"
    yield _check("open files", status, found, serves, remedy)

    soft, _ = resource.getrlimit(resource.RLIMIT_NPROC)
    serves = "a run has up to 40"
    if soft == resource.RLIM_INFINITY or os.getuid() == 0:
        yield HostCheck("processes", "ok", "unlimited", serves)
        return
    mine = sum(1 for _ in run_directory.pids())
    remedy = f"ulimit -u {mine + PROCESSES_MIN}, or more"
    status = _graded(soft - mine, PROCESSES_MIN, PROCESSES_MIN)
    yield _check("processes", status, f"{max(0, soft - mine)} more allowed", serves, remedy)


# -- the directory of all runs --------------------------------------------------------------------


def _place() -> Iterator[HostCheck]:
    name, serves = "run directory", "control sockets and records of runs, closed to others"
    try:
        root = run_directory.root()
    except ConfigError as error:
        remedy = "remove it, or set XDG_RUNTIME_DIR or TMPDIR to a directory of yours"
        yield HostCheck(name, "missing", str(error), serves, remedy)
        return
    over = run_directory.socket_bytes(root) - run_directory.SOCKET_PATH_MAX
    if over > 0:
        found = f"{root}: {over} bytes too long for a socket's path"
        yield HostCheck(name, "missing", found, serves, "set XDG_RUNTIME_DIR or TMPDIR to a shorter path")
        return
    yield HostCheck(name, "ok", f"{root}, mode 0700", serves)
    free = shutil.disk_usage(root).free
    status = _graded(free, FREE_BYTES_MIN, FREE_BYTES_GOOD)
    remedy = "make room, or keep records elsewhere: aftbed run --record"
    yield _check("space", status, f"{free / 1e6:.0f} MB free in {root}", "journals and bus logs", remedy)


# -- Python ---------------------------------------------------------------------------------------


def _python() -> Iterator[HostCheck]:
    """The interpreter, and the packages that aftbed cannot do without."""
    yield HostCheck("Python", "ok", platform.python_version(), "the interpreter of all nodes")
    serves = "a failed assert ends a node: fail-silence"
    status: Status = "ok" if __debug__ else "missing"
    yield _check("asserts", status, "on" if __debug__ else "off", serves, "no -O, no PYTHONOPTIMIZE")

    serves = "the bus, the wire format, the command line"
    try:
        wanted = [r for r in importlib.metadata.requires("aftbed") or [] if "extra ==" not in r]
    except importlib.metadata.PackageNotFoundError:
        yield HostCheck("packages", "warning", "aftbed is not installed", serves, "pip install .")
        return
    names = [match[0] for match in (re.match(r"[\w.-]+", r) for r in wanted) if match]
    lacking = [name for name in names if not _version(name)]
    found = f"without {', '.join(lacking)}" if lacking else f"all {len(names)}"
    status = "missing" if lacking else "ok"
    yield _check("packages", status, found, serves, f"pip install {' '.join(lacking)}")


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _extras() -> Iterator[HostCheck]:
    """What single commands need."""
    for package, serves in OPTIONAL.items():
        version = _version(package)
        status: Status = "ok" if version else "warning"
        yield _check(package, status, version or "not installed", serves, f"pip install {package}")
    browser = next((where for name in BROWSERS if (where := shutil.which(name))), "")
    status = "ok" if browser else "warning"
    serves = "tests of the HTML report, and nothing else"
    yield _check("Chromium", status, browser or "not found", serves, "install chromium")


def _foreign_memory() -> HostCheck:
    """Whether the memory of a child can be written, by trying it."""
    serves = "aftbed inject bitflip --level memory"
    try:
        scope = YAMA.read_text().strip()
    except OSError:
        scope = "none"  # a kernel without Yama
    try:
        try_on_a_child()
    except (OSError, HarnessError) as error:
        remedy = f"echo 1 > {YAMA}, or CAP_SYS_PTRACE; in a container, allow process_vm_writev"
        return HostCheck("memory of nodes", "warning", f"{error} (Yama scope: {scope})", serves, remedy)
    return HostCheck("memory of nodes", "ok", f"can be written (Yama scope: {scope})", serves)


# -- measuring ------------------------------------------------------------------------------------


def _measuring() -> Iterator[HostCheck]:
    """What makes times larger, or scatter; verdicts do not depend on it."""
    files = Path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    kinds = {file.read_text().strip() for file in files}
    found = ", ".join(sorted(kinds)) or "not to be seen from here"
    status: Status = "ok" if kinds <= {"performance"} else "warning"
    serves = "benches: a clock that stays as it is"
    yield _check("CPU governor", status, found, serves, "cpupower frequency-set -g performance")

    before = _jiffies()
    time.sleep(STEAL_SECONDS)  # what is sampled, not what is waited for
    passed = [b - a for a, b in zip(before, _jiffies(), strict=True)]
    share = passed[STEAL] / max(1, sum(passed))
    status = "ok" if share <= STEAL_MAX else "warning"
    remedy = "other guests of this machine take its CPUs: measure elsewhere, or later"
    yield _check("CPU steal", status, f"{share:.1%}", "benches: a core that is ours", remedy)

    load, count = os.getloadavg()[0], os.cpu_count() or 1
    status = "ok" if load < count else "warning"
    found, serves = f"{load:.1f} on {count} CPUs", "benches: nothing else runs"
    yield _check("load", status, found, serves, "measure when nothing else runs")


def _jiffies() -> list[int]:
    return [int(word) for word in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
