"""G5: what lives at the end of a run is a whole graph, the one to which its adaptations came.

"An adaptation either completes or leaves the graph that was there: never half of one" (design 3). Of a run
that ended before redundancy was back, the backup's bricks are not asked for.
"""

from aftbed.core import check
from aftbed.ftm.compose import build, replication_of
from aftbed.runtime.hosting import Hosted


def half_a_graph(hosted: Hosted, expected: str) -> list[str]:
    """What is missing, or should not be there, where `expected` is the FTM that should run; [] if whole."""
    if not hosted.leader:
        return ["nobody leads"]
    if hosted.ftm != expected:
        return [f"{hosted.ftm} runs, though the adaptations came to {expected}"]
    duplex = bool(replication_of(expected))
    whole = build(expected, hosted.placement, hosted.leader if duplex else "a")
    joining = "" if hosted.backup or not duplex else ("b" if hosted.leader == "a" else "a")
    return [r for r in check.missing(hosted.bricks, whole) if not joining or not r.startswith(f"{joining}/")]
