"""A campaign over many machines: experiments as tasks of a Dask scheduler (`aftbed[dask]`).

The scheduler hands each experiment to a worker that is free, and to another one if that dies in the midst
of it; only this process writes the ledger, and it takes each experiment once, so a worker's death loses
nothing and counts nothing twice. A real run is started in an interpreter of its own on the worker, since a
Dask worker has threads and a run is begun by a fork. Every machine needs the same version of aftbed: the
answer names the code that made it, and that of another version is refused.
"""

import os
import subprocess
import sys
from collections.abc import Generator, Iterator
from itertools import islice
from typing import TYPE_CHECKING, Final

import msgspec

from aftbed.campaign.experiment import Experiment, Result, carry_out
from aftbed.core.errors import ConfigError, HarnessError
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.code_version import code_version

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT_SECONDS_MAX: Final = 10
RUN_SECONDS_MAX: Final = 120.0
AGAIN_MAX: Final = 3  # workers that may die under one experiment
SILENCE_SECONDS_MAX: Final = (AGAIN_MAX + 1) * RUN_SECONDS_MAX + 60.0  # as long as one may take, tried again
AHEAD: Final = 3  # experiments per thread of the cluster that are handed out before they are asked for

Answer = tuple[str, bytes]  # the code version, and the result


def perform(task: bytes) -> Answer:
    """On a worker: one experiment."""
    experiment = msgspec.json.decode(task, type=Experiment)
    if experiment.runtime == "sim":
        return code_version(), msgspec.json.encode(carry_out(experiment, lambda _: None))
    command = [sys.executable, "-P", "-m", "aftbed.campaign.dask", str(os.getpid())]
    done = subprocess.run(command, input=task, capture_output=True, timeout=RUN_SECONDS_MAX, check=False)
    if done.returncode != 0:
        raise HarnessError(f"a worker could not run {experiment.id}: {done.stderr.decode()[-500:]}")
    return code_version(), done.stdout


def connect(address: str) -> "Client":
    """To the scheduler. Raises ConfigError."""
    try:
        from distributed import Client  # noqa: PLC0415 - an extra
    except ImportError:
        raise ConfigError("--executor dask: not installed: pip install 'aftbed[dask]'") from None
    try:
        return Client(address, timeout=CONNECT_SECONDS_MAX)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--scheduler {address}: cannot be reached: {error}") from None


def over(client: "Client", experiments: Iterator[Experiment]) -> Generator[Result, None, None]:
    """Every result as it comes. Raises HarnessError where an experiment cannot be had."""
    from distributed import wait  # noqa: PLC0415

    threads = sum(client.nthreads().values())
    if not threads:
        raise HarnessError("the scheduler has no workers: start some, as `dask worker ADDRESS`")
    pending: set[Future[Answer]] = set()
    while True:
        for experiment in islice(experiments, AHEAD * threads - len(pending)):
            task = msgspec.json.encode(experiment)
            key = f"aftbed-{experiment.id}"
            pending.add(client.submit(perform, task, key=key, retries=AGAIN_MAX, pure=False))
        if not pending:
            return
        try:
            done, pending = wait(pending, timeout=SILENCE_SECONDS_MAX, return_when="FIRST_COMPLETED")
        except TimeoutError:
            raise HarnessError(
                f"no worker has answered for {SILENCE_SECONDS_MAX:g} s: are there any left? --resume goes on"
            ) from None
        yield from map(_answered, done)


def _answered(future: "Future[Answer]") -> Result:
    try:
        code, data = future.result()
    except Exception as error:  # whatever a worker died of
        raise HarnessError(f"experiment {future.key}: {type(error).__name__}: {error}") from error
    if code != code_version():
        raise ConfigError(f"a worker has aftbed {code}, this is {code_version()}: install the same one")
    return msgspec.json.decode(data, type=Result)


def main() -> None:
    """One experiment from stdin, its result to stdout: a real run's interpreter. It dies with its worker."""
    linux.die_with(int(sys.argv[1]))
    experiment = msgspec.json.decode(sys.stdin.buffer.read(), type=Experiment)
    sys.stdout.buffer.write(msgspec.json.encode(carry_out(experiment, lambda _: None)))


if __name__ == "__main__":
    main()
