"""The registry: all mechanisms and all kinds of bricks. A new mechanism is one line in MECHANISMS."""

from typing import Final, NamedTuple

from aftbed.core.brick import Brick
from aftbed.core.events import Event
from aftbed.core.graph import Graph, Kind
from aftbed.ftm.assertion import ASSERT
from aftbed.ftm.chain import COMPUTE, INNER_PROTOCOL, PASS_BEFORE, PROTOCOL
from aftbed.ftm.client import CLIENT, PROXY
from aftbed.ftm.declaration import BrickKind, Mechanism, Setting
from aftbed.ftm.failover import RECOVERY, WATCHDOG
from aftbed.ftm.lfr import LFR
from aftbed.ftm.pbr import PBR
from aftbed.ftm.server import BARE_SERVER, SERVER
from aftbed.ftm.supervision import SUP
from aftbed.ftm.tr import TR

__all__ = ["EMITTERS", "KINDS", "MECHANISMS", "Setting", "make"]

MECHANISMS: Final[dict[str, Mechanism]] = {one.name: one for one in (PBR, LFR, TR, ASSERT, SUP)}

BRICKS: Final[dict[str, BrickKind]] = {
    kind.name: kind
    for kind in (
        *(CLIENT, PROXY, PROTOCOL, INNER_PROTOCOL, PASS_BEFORE, COMPUTE, SERVER, BARE_SERVER),
        *(kind for one in MECHANISMS.values() for kind in (one.before, one.proceed, one.after)),
        *(WATCHDOG, RECOVERY),
    )
}
ENGINE: Final = Kind("engine", (), ())  # it plans adaptations, so it is made in `adapt`
KINDS: Final[dict[str, Kind]] = {**BRICKS, ENGINE.name: ENGINE}


def make(kind: str, setting: Setting) -> Brick:
    return BRICKS[kind].make(setting)


class Emitter(NamedTuple):
    """`part`: the kind that emits the event, or the last word of all kinds that do."""

    part: str
    of_backup: bool  # the backup's brick emits it, else the leader's


def _emitters() -> dict[Event, Emitter]:
    declared: dict[Event, list[tuple[str, bool]]] = {}
    for kind in BRICKS.values():
        for one in kind.events:
            name = SERVER.name if one.by_server else kind.name
            declared.setdefault(one.event, []).append((name, one.of_backup))
    return {event: _emitter(event, kinds) for event, kinds in declared.items()}


def _emitter(event: Event, kinds: list[tuple[str, bool]]) -> Emitter:
    names, of_backup = {name for name, _ in kinds}, kinds[0][1]
    word = last_word(kinds[0][0])
    silent = {name for name in BRICKS if last_word(name) == word} - names
    assert len(names) == 1 or not silent, f"{sorted(silent)} do not declare {event}, as all others do"
    assert {(last_word(name), backup) for name, backup in kinds} == {(word, of_backup)}, f"{event}: {kinds}"
    return Emitter(names.pop() if len(names) == 1 else word, of_backup)


def last_word(name: str) -> str:
    """The part that a kind, or a brick of an inner mechanism, is: `tr.before` is a `before`."""
    return name.rpartition(".")[2]


EMITTERS: Final = _emitters()


def server_emits(graph: Graph, event: Event, *, backs_up: bool) -> bool:
    """Whether the Server of a replica of `graph` that leads, or that `backs_up`, emits `event`."""
    kinds = [BRICKS[brick.kind] for brick in graph.bricks if brick.kind in BRICKS]
    declared = {
        one.of_backup
        for kind in kinds
        for one in kind.events
        if one.event is event and (one.by_server or last_word(kind.name) == SERVER.name)
    }
    if backs_up:
        return True in declared or (False in declared and any(kind.backup_executes for kind in kinds))
    return False in declared


REPLY_CHECKERS: Final = tuple(kind.name for kind in BRICKS.values() if kind.checks_replies)
