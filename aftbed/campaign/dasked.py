"""A campaign over many machines: experiments as tasks of a Dask scheduler (`aftbed[dask]`).

The scheduler hands each experiment to a worker that is free, and to another one if that dies in the midst
of it; only this process writes the ledger, and it takes each experiment once, so a worker's death loses
nothing and counts nothing twice. A real run is started in an interpreter of its own on the worker, since a
Dask worker has threads and a run is begun by a fork. Every machine needs the same version of aftbed: the
answer says by which code it was made, and another's is refused.
"""

import subprocess
import sys
from collections.abc import Generator, Iterator
from itertools import islice
from typing import TYPE_CHECKING, Final

import msgspec

from aftbed.campaign.executing import carry_out
from aftbed.campaign.experiment import Experiment, Result
from aftbed.campaign.planning import code_version
from aftbed.core.errors import ConfigError, HarnessError

if TYPE_CHECKING:
    from distributed import Client

CONNECT_SECONDS_MAX: Final = 10
RUN_SECONDS_MAX: Final = 120.0
AHEAD: Final = 3  # experiments per thread of the cluster that are handed out before they are asked for
AGAIN_MAX: Final = 3  # workers that may die under one experiment

Answer = tuple[str, bytes]  # the code version, and the result


def perform(task: bytes) -> Answer:
    """On a worker: one experiment."""
    experiment = msgspec.json.decode(task, type=Experiment)
    if experiment.runtime == "sim":
        return code_version(), msgspec.json.encode(carry_out(experiment, lambda _: None))
    command = [sys.executable, "-P", "-m", "aftbed.campaign.dasked"]
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
    from distributed import as_completed  # noqa: PLC0415

    threads = sum(client.nthreads().values())
    if not threads:
        raise HarnessError("the scheduler has no workers: start some, as `dask worker ADDRESS`")
    pending = as_completed()

    def hand_out(count: int) -> None:
        for experiment in islice(experiments, count):
            task = msgspec.json.encode(experiment)
            pending.add(
                client.submit(perform, task, key=f"aftbed-{experiment.id}", retries=AGAIN_MAX, pure=False)
            )

    hand_out(AHEAD * threads)
    for future in pending:
        try:
            code, data = future.result()
        except Exception as error:  # whatever a worker died of
            raise HarnessError(f"experiment {future.key}: {type(error).__name__}: {error}") from error
        if code != code_version():
            raise ConfigError(f"a worker has aftbed {code}, this is {code_version()}: install the same one")
        yield msgspec.json.decode(data, type=Result)
        hand_out(1)


def main() -> None:
    """One experiment from stdin, its result to stdout: the interpreter of a real run."""
    experiment = msgspec.json.decode(sys.stdin.buffer.read(), type=Experiment)
    sys.stdout.buffer.write(msgspec.json.encode(carry_out(experiment, lambda _: None)))


if __name__ == "__main__":
    main()
