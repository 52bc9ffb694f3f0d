"""The states in which the Servers of a simulated run end: see `runtime.hosting`."""

import contextlib

from aftbed.core.errors import PeerError
from aftbed.runtime.cell import look
from aftbed.runtime.deployment import Deployment
from aftbed.runtime.hosting import digest
from aftbed.runtime.sim.processes import Process


def states_of(deployment: Deployment) -> dict[str, str]:
    """Digests, by replica; none of one that is stopped, or whose function hands out no state."""
    found: dict[str, str] = {}
    for replica in filter(None, (deployment.leader, deployment.backup)):
        process = deployment.nodes.get(deployment.graph.node_of(f"{replica}/server"))
        if isinstance(process, Process) and process.node is not None and not process.stopped():
            with contextlib.suppress(PeerError):
                state = look(process.node.hosted(f"{replica}/server").brick)
                found |= {replica: digest(state)} if state else {}
    return found
