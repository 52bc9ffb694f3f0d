"""What of a graph lives at the end of a run, and in which state: for the judgement (G5, `latent`)."""

import contextlib
import hashlib
from typing import Final

import msgspec

from aftbed.core.errors import StepFailed
from aftbed.runtime import control
from aftbed.runtime.deployment import Deployment, Keys
from aftbed.runtime.interface import ProcessKind

DIGEST_DIGITS: Final = 16


class Hosted(msgspec.Struct, frozen=True):
    """`leader` and `backup` name replicas, or nobody (`""`); `bricks`: their names, with the kind of each."""

    ftm: str
    placement: str
    leader: str
    backup: str
    bricks: tuple[tuple[str, str], ...]


def hosted(deployment: Deployment) -> Hosted:
    """As the executive sees it at this moment: a node that is dead, and not yet seen dead, lives."""
    graph = deployment.graph
    living = [p for p in deployment.pool.processes if p.alive and p.kind is not ProcessKind.KILLED]
    bricks = tuple(sorted(brick for process in living for brick in process.bricks))
    return Hosted(graph.ftm, graph.placement, deployment.leader, deployment.backup, bricks)


def digest(state: bytes) -> str:
    """Short, for a record; equal states have the same."""
    return hashlib.sha256(state).hexdigest()[:DIGEST_DIGITS]


def look_at_states(deployment: Deployment, found: dict[str, str]) -> Keys:
    """Put the digest of each Server's state into `found`, by replica; a function may hand out none."""
    for replica in (deployment.leader, deployment.backup):
        with contextlib.suppress(StepFailed):
            yield from _look_at(deployment, replica, found)


def _look_at(deployment: Deployment, replica: str, found: dict[str, str]) -> Keys:
    server = f"{replica}/server"
    if not any(b.name == server for b in deployment.graph.bricks):
        return
    node = deployment.graph.node_of(server)
    state = yield from deployment.ask(node, lambda token: control.Capture(token, server, look=True))
    if state:
        found[replica] = digest(state)
