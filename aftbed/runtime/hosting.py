"""What of a graph lives, at the end of a run: for the judgement whether it is whole (G5)."""

import msgspec

from aftbed.runtime.deployment import Deployment


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
    living = [p for p in deployment.nursery.processes if p.alive and p.kind != "killed"]
    bricks = tuple(sorted(brick for process in living for brick in process.bricks))
    return Hosted(graph.ftm, graph.placement, deployment.leader, deployment.backup, bricks)
