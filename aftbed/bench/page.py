"""Cycle time at the client while a page reads the run, beside that without a page.

Both are runs of their own under a closed load, in turn (`rounds`). A page here is a connection to the page's
server that reads what it sends, as a browser does; what a browser takes to draw it is not in the figure.
"""

import contextlib
import http.client
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from aftbed.bench.rounds import ROUNDS, InRounds, beside_limit, in_turn
from aftbed.bench.runs import Percentiles, endless_run, latencies_us, percentiles, wait_until_ready
from aftbed.report import live_page
from aftbed.runtime.unix.launch import listen_on_loopback

SILENT_SECONDS_MAX: Final = 10.0  # of a page, which has something to say many times a second


class PageResult(InRounds, frozen=True):
    """The document of `aftbed bench page`; the limit is the cycle without a page."""

    ftm: str
    placement: str
    requests: int
    snapshots: int
    cycle_us: Percentiles


def bench_page(
    ftm: str, placement: str, seconds: float, *, pin: bool = True, rounds: int = ROUNDS
) -> PageResult:
    """Each round has two runs, which are measured for so long."""
    read: list[int] = []

    def cycle(*, page: bool) -> list[float]:
        with endless_run(ftm, placement, pin=pin) as run:
            wait_until_ready(run.private)
            with reading(run.private, read) if page else contextlib.nullcontext():
                began_ns = time.monotonic_ns()
                time.sleep(seconds)  # what is sampled, not what is waited for
                ended_ns = time.monotonic_ns()
        return latencies_us(run.record, began_ns=began_ns, ended_ns=ended_ns)

    found = in_turn(rounds, lambda number: cycle(page=True), lambda number: cycle(page=False))
    cycles = [us for values in found.figures for us in values]
    beside = beside_limit("cycle without a page", found.figures, found.limits, 1)
    return PageResult(
        ftm,
        placement,
        len(cycles),
        sum(read),
        percentiles(cycles, 1),
        limit=beside.limit,
        ratio=beside.ratio,
        machine=found.machine,
    )


@contextlib.contextmanager
def reading(private: Path, read: list[int]) -> Iterator[None]:
    """A page of the run reads in the block, from its first snapshot on; `read` gets how many there were."""
    listener, token = listen_on_loopback(0, "--port"), live_page.new_token()
    host, port = listener.getsockname()
    with live_page.beside(listener, private, token):
        line = http.client.HTTPConnection(host, port, timeout=SILENT_SECONDS_MAX)
        line.request("GET", f"/stream?token={token}")
        stream = line.getresponse()
        snapshots = 1  # the first one, below

        def read_all() -> None:
            nonlocal snapshots
            with contextlib.suppress(OSError, http.client.HTTPException):
                for text in stream:
                    snapshots += text.startswith(b"data: ")

        assert stream.readline().startswith(b"data: "), "the page of a run that lives"
        reader = threading.Thread(target=read_all)
        reader.start()
        try:
            yield
        finally:
            read.append(snapshots)
    reader.join()
    line.close()
