"""How a simulated run comes to its end: whether all is asked and answered, what is not at rest, which states.

The states are those of the Servers: see `runtime.hosting`.
"""

import contextlib

from aftbed.core.errors import PeerError
from aftbed.ftm.client import Client
from aftbed.ftm.compose import replication_of
from aftbed.inject.shared_state import look
from aftbed.runtime.deployment import Deployment
from aftbed.runtime.devices import CarDevice, Load
from aftbed.runtime.hosting import digest
from aftbed.runtime.run_controller import RunController
from aftbed.runtime.sim.devices import VirtualCarLink
from aftbed.runtime.sim.node_io import SimNode
from aftbed.runtime.sim.processes import SimProcess


def states_of(deployment: Deployment) -> dict[str, str]:
    """Digests, by replica; none of one that is stopped, or whose function hands out no state."""
    found: dict[str, str] = {}
    for replica in filter(None, (deployment.leader, deployment.backup)):
        process = deployment.nodes.get(deployment.graph.node_of(f"{replica}/server"))
        if isinstance(process, SimProcess) and process.node is not None and not process.stopped():
            with contextlib.suppress(PeerError):
                state = look(process.node.brick(f"{replica}/server"))
                found |= {replica: digest(state)} if state else {}
    return found


def _client(deployment: Deployment) -> SimNode | None:
    process = deployment.nodes.get("client")
    return process.node if isinstance(process, SimProcess) and not process.dead else None


def source_ended(deployment: Deployment, count: int) -> bool:
    """Whether all requests have been made, be they answered or not."""
    node = _client(deployment)
    if node is None or node.device is None:
        return False
    if isinstance(node.device, CarDevice):
        return _drive_over(node.device)
    client = node.brick("client")
    return isinstance(client, Client) and client.next_id > count


def _drive_over(car: CarDevice) -> bool:
    assert isinstance(car.link, VirtualCarLink)
    return car.link.over


def unrest(controller: RunController) -> list[str]:
    """Why the run has not come to rest."""
    deployment, found = controller.deployment, []
    node = _client(deployment)
    device = node.device if node is not None else None
    if not isinstance(device, Load | CarDevice):
        found.append("no client")
    elif not (device.done if isinstance(device, Load) else _drive_over(device) and device.idle):
        found.append("requests wait")
    if controller.executor.busy or controller.adaptations.busy or controller.adaptations.to_come:
        found.append("a script is under way")
    if replication_of(deployment.graph.ftm) and not deployment.backup:
        found.append("no redundancy")
    found += [f"{name} is under way" for name in deployment.runtime.loop.tasks.names()]
    processes = [p for p in deployment.nodes.values() if isinstance(p, SimProcess)]
    found += [f"{p.name} is dead or stopped" for p in processes if p.stopped()][:1]
    return found
