"""What is declared of a kind of brick and of a mechanism, each in one place.

The registry collects the declarations. All that the rest of the system knows of a mechanism is read from
there: its graph, whether it suits a function, at which events a fault can be aimed, how many hops a request
takes, which experiments the explorers make.
"""

from collections.abc import Callable
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from aftbed.core.application import Application
from aftbed.core.brick import Brick
from aftbed.core.events import Event
from aftbed.core.graph import Kind
from aftbed.ftm.pages import PAGE_BYTES

FaultClass = Literal["crash", "value", "implausible", "flow"]
Level = Literal["none", "low", "high"]


class Setting(msgspec.Struct, frozen=True):
    """What a brick is made for: which replica (1, 2; 0 for none), which epoch, leading or not.

    `page_bytes`: of a page of a checkpoint, which a test may make small.
    """

    replica: int
    epoch: int
    leads: bool
    application: Callable[[], Application]
    page_bytes: int = PAGE_BYTES


class Emits(msgspec.Struct, frozen=True):
    """An event at which a fault can be aimed.

    `of_backup`: the backup's brick emits it, else the leader's. `by_server`: the Server emits it, when asked
    by this brick.
    """

    event: Event
    of_backup: bool = False
    by_server: bool = False


class BrickKind(Kind, frozen=True, kw_only=True):
    """A kind of brick: its ports, how one is made, and what others must know of its behaviour.

    `events`: where a fault can be aimed. Either all kinds of one part (`before`, `after`) emit an event,
    or one kind alone does.
    `visits`: the event that it notes when a request or its reply visits it: first visit, second visit, ...
    `asks_server`: how often it asks the Server and waits for the answer, for one request.
    `sends_beside`: it sends more than one message in the step of its note.
    `backup_executes`: with this brick, the Server of the backup executes every request too.
    `checks_replies`: it asks the protected function whether a reply can be right.
    `told_redundancy`: the one of the leader is told whether there is a backup (`Redundancy`).
    """

    make: Callable[[Setting], Brick]
    events: tuple[Emits, ...] = ()
    visits: tuple[Event | None, ...] = ()
    asks_server: int = 0
    sends_beside: bool = False
    backup_executes: bool = False
    checks_replies: bool = False
    told_redundancy: bool = False


class Suitability(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a mechanism tolerates, and what it needs: FT, A and R.

    `deterministic`, `state_access`, `exact_state`: why the function must have it; empty: it need not.
    """

    tolerates: tuple[FaultClass, ...] = ()  # faults that are not seen
    detects: tuple[FaultClass, ...] = ()  # faults at which it stops its replica
    deterministic: str = ""
    state_access: str = ""
    exact_state: str = ""
    cpus: Annotated[int, Meta(ge=1, le=1024)] = 1  # at least
    cpu_load: Level = "low"  # what it takes
    bandwidth: Level = "none"  # what it takes


class Mechanism(msgspec.Struct, frozen=True, kw_only=True):
    """A mechanism: its Before, Proceed and After, how they are linked, and what it is for.

    `links`: those of this mechanism only, from part to part through a port that both ends call the same.
    `replication`: parts and ports by which a leader sends to its backup; none: one replica.
    `combined`: it is listed with each other mechanism that makes sense; else only inside of those that
    replicate, which keeps the list of all expressions short.
    `innermost`: its Proceed is part of what it does, so no other mechanism can take that place.
    `adaptations_explored`: `explore adapt` makes all adaptations from and to it, without being told to.
    """

    name: str
    before: BrickKind
    proceed: BrickKind
    after: BrickKind
    links: tuple[tuple[str, str, str], ...] = ()
    replication: tuple[tuple[str, str], ...] = ()
    innermost: bool = False
    suitability: Suitability
    combined: bool = True
    adaptations_explored: bool = True
