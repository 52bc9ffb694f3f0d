"""Which core a node runs on: a chain is sequential, so it stays on one; the other replica's has another.

Client and Proxy stay beside the leader. A Watchdog is on another core than the replica that it watches, and
Recovery on another than the leader: a core on which a replica has just died is busy for a while with
taking it down.
"""

import itertools
from typing import Final

from aftbed.ftm.compose import REPLICAS

BESIDE_LEADER: Final = ("client", "proxy")


class Cores:
    """`cpus` are those that may be used; None leaves it all to the kernel."""

    def __init__(self, cpus: list[int] | None) -> None:
        self._of_replica = dict(zip(REPLICAS, itertools.cycle(cpus), strict=False)) if cpus else {}

    def of(self, node: str, hosted: tuple[str, ...], leader: str) -> int | None:
        """The core of `node`, which hosts these bricks, while `leader` leads."""
        if node.endswith("/watchdog"):
            return self._other_than(node.partition("/")[0])
        if hosted and all("/" in brick for brick in hosted):
            return self._of_replica.get(hosted[0].partition("/")[0])
        if node in BESIDE_LEADER:
            return self._of_replica.get(leader)
        return self._other_than(leader)

    def _other_than(self, replica: str) -> int | None:
        return next((cpu for name, cpu in self._of_replica.items() if name != replica), None)
