"""The registry: all mechanisms and all kinds of bricks. A mechanism of ours is one line in `_SHIPPED`.

An installed package can have mechanisms too: each is an entry point of the group `aftbed.mechanisms`, whose
name is that of the mechanism (docs/plugins.md). Packages are looked at when a name is asked for that is not
ours, or all names are (`find`, `load_installed`); from then on their mechanisms stand in the tables of this
module beside ours. A package that cannot be used is told where its mechanism is asked for, or all are.
"""

import re
from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple, TypeVar

from aftbed.core.brick import Brick
from aftbed.core.errors import ConfigError
from aftbed.core.events import Event
from aftbed.core.graph import Graph, Kind
from aftbed.core.installed import EntryPoint, entry_points
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

__all__ = ["EMITTERS", "KINDS", "MECHANISMS", "SHIPPED", "Setting", "make"]

_SHIPPED: Final = {one.name: one for one in (PBR, LFR, TR, ASSERT, SUP)}
SHIPPED: Final = tuple(_SHIPPED)
GROUP: Final = "aftbed.mechanisms"
NAME: Final = re.compile(r"[a-z][a-z0-9]{0,19}")
PARTS: Final = ("before", "proceed", "after")
RESERVED: Final = ("none", "engine")  # words where the name of a mechanism may stand, too

K = TypeVar("K", bound=Kind)


class KindTable(dict[str, K]):
    """By the name of the kind. One that is not there may be of an installed mechanism: `limit.after`.

    A node, and a reader of a script, is given the kind before the mechanism.
    """

    def __missing__(self, name: str) -> K:
        if name in self:
            return self[name]
        raise KeyError(name)

    def __contains__(self, name: object) -> bool:
        if not super().__contains__(name) and isinstance(name, str):
            mechanism, dot, _ = name.partition(".")
            if dot and mechanism not in MECHANISMS:
                find(mechanism)
        return super().__contains__(name)


def _kinds_of(mechanism: Mechanism) -> tuple[BrickKind, ...]:
    return mechanism.before, mechanism.proceed, mechanism.after


def _bricks_of(mechanism: Mechanism) -> dict[str, BrickKind]:
    return {kind.name: kind for kind in _kinds_of(mechanism)}


MECHANISMS: Final = dict(_SHIPPED)  # and those of installed packages that were asked for
BRICKS: Final = KindTable[BrickKind](
    (kind.name, kind)
    for kind in (
        *(CLIENT, PROXY, PROTOCOL, INNER_PROTOCOL, PASS_BEFORE, COMPUTE, SERVER, BARE_SERVER),
        *(kind for one in MECHANISMS.values() for kind in _kinds_of(one)),
        *(WATCHDOG, RECOVERY),
    )
)
ENGINE: Final = Kind("engine", (), ())  # it plans adaptations, so it is made in `adapt`
KINDS: Final = KindTable[Kind](BRICKS | {ENGINE.name: ENGINE})


def make(kind: str, setting: Setting) -> Brick:
    return BRICKS[kind].make(setting)


class Emitter(NamedTuple):
    """`part`: the kind that emits the event, or the last word of all kinds that do."""

    part: str
    of_backup: bool  # the backup's brick emits it, else the leader's


def _emitters(bricks: Mapping[str, BrickKind]) -> dict[Event, Emitter]:
    """Raises ConfigError where neither all kinds of one part emit an event, nor one kind alone does."""
    declared: dict[Event, list[tuple[str, bool]]] = {}
    for kind in bricks.values():
        for one in kind.events:
            name = SERVER.name if one.by_server else kind.name
            declared.setdefault(one.event, []).append((name, one.of_backup))
    return {event: _emitter(event, kinds, bricks) for event, kinds in declared.items()}


def _emitter(event: Event, kinds: list[tuple[str, bool]], bricks: Mapping[str, BrickKind]) -> Emitter:
    names, of_backup = {name for name, _ in kinds}, kinds[0][1]
    word = last_word(kinds[0][0])
    silent = {name for name in bricks if last_word(name) == word} - names
    if len(names) > 1 and silent:
        others = ", ".join(sorted(names))
        raise ConfigError(f"{', '.join(sorted(silent))} must declare the event {event.label}, as {others} do")
    if {(last_word(name), backup) for name, backup in kinds} != {(word, of_backup)}:
        raise ConfigError(f"the event {event.label} is of {word}, and of one replica")
    return Emitter(names.pop() if len(names) == 1 else word, of_backup)


def last_word(name: str) -> str:
    """The part that a kind, or a brick of an inner mechanism, is: `tr.before` is a `before`."""
    return name.rpartition(".")[2]


EMITTERS: Final = _emitters(BRICKS)


def server_emits(graph: Graph, event: Event, *, backs_up: bool) -> bool:
    """Whether the Server of a replica of `graph` that leads, or that `backs_up`, emits `event`."""
    kinds = [BRICKS[brick.kind] for brick in graph.bricks if brick.kind != ENGINE.name]
    declared = {
        one.of_backup
        for kind in kinds
        for one in kind.events
        if one.event is event and (one.by_server or last_word(kind.name) == SERVER.name)
    }
    if backs_up:
        return True in declared or (False in declared and any(kind.backup_executes for kind in kinds))
    return False in declared


# -- installed packages ---------------------------------------------------------------------------

_unusable: Final[dict[str, ConfigError]] = {}


def _points(name: str) -> list[EntryPoint]:
    return [point for point in entry_points(GROUP) if point.name == name]


def names() -> tuple[str, ...]:
    """Of all mechanisms, ours first. Packages are not imported for that."""
    return tuple(dict.fromkeys((*SHIPPED, *(point.name for point in entry_points(GROUP)))))


def find(name: str) -> Mechanism | None:
    """The mechanism of that name. Raises ConfigError where the package that declares it cannot be used."""
    if name not in MECHANISMS:
        points = _points(name)
        if not points:
            return None
        if name in _unusable:
            raise _unusable[name]
        try:
            _add(_loaded(name, points))
        except ConfigError as error:
            _unusable[name] = error
            raise
    return MECHANISMS[name]


def load_installed() -> list[str]:
    """Find all mechanisms of installed packages; why some of them cannot be used, a sentence each."""
    found = []
    for name in dict.fromkeys(point.name for point in entry_points(GROUP)):
        points = _points(name)
        try:
            if name in SHIPPED:
                raise unusable(name, points, f"aftbed has a mechanism {name} of its own, which is used")
            find(name)
        except ConfigError as error:
            found.append(str(error))
    return found


def leave_out(name: str, why: ConfigError) -> None:
    """Have `find` raise `why` from here on."""
    del MECHANISMS[name]
    _unusable[name] = why


def installed_mechanisms() -> tuple[str, ...]:
    """The mechanisms of installed packages that were asked for in this process."""
    return tuple(name for name in MECHANISMS if name not in SHIPPED)


def packages_of(names: Iterable[str]) -> tuple[str, ...]:
    """The name and version of each package that declares one of these mechanisms; () if all are ours."""
    theirs = {name for name in names if name not in SHIPPED}
    return tuple(dict.fromkeys(p.package for p in entry_points(GROUP) if p.name in theirs)) if theirs else ()


def unusable(name: str, points: list[EntryPoint], why: str) -> ConfigError:
    """The error to raise where what a package declares cannot be used."""
    packages = " and ".join(point.package for point in points)
    remove = points[-1].package.rpartition(" ")[0]
    return ConfigError(
        f"FTM {name} of the package {packages}: {why};"
        f" repair the package, or remove it: pip uninstall {remove}"
    )


def misfit(name: str, problems: list[str]) -> ConfigError:
    """The error to raise where a graph with an installed mechanism does not fit together."""
    return unusable(name, _points(name), f"its declaration does not fit: {'; '.join(problems)}")


def _loaded(name: str, points: list[EntryPoint]) -> Mechanism:
    if len(points) > 1:
        raise unusable(name, points, "both declare it, and one of them has to go")
    try:
        return _checked(name, points[0].load())
    except (Exception, SystemExit) as error:  # whatever a stranger's module does
        what = str(error) if isinstance(error, ConfigError) else f"{type(error).__name__}: {error}"
        raise unusable(name, points, f"{points[0].place}: {' '.join(what.split())}") from error


def _checked(name: str, found: object) -> Mechanism:
    """What an entry point names. Raises ConfigError if it cannot be used."""
    if not NAME.fullmatch(name) or name in RESERVED:
        raise ConfigError("a mechanism has a name of a small letter, then up to 19 small letters and digits")
    if not isinstance(found, Mechanism):
        raise ConfigError(f"found {type(found).__name__} {found!r:.60}, allowed is Mechanism(...)")
    if found.name != name:
        raise ConfigError(f"found a mechanism called {found.name}, allowed is the entry point's name")
    for part, kind in zip(PARTS, _kinds_of(found), strict=True):
        if kind.name != f"{name}.{part}" and BRICKS.get(kind.name) is not kind:
            raise ConfigError(f"{part}: found a kind of brick {kind.name!r}, allowed is {name}.{part}")
    _emitters(BRICKS | _bricks_of(found))
    return found


def _add(mechanism: Mechanism) -> None:
    MECHANISMS[mechanism.name] = mechanism
    BRICKS.update(_bricks_of(mechanism))
    KINDS.update(_bricks_of(mechanism))
    EMITTERS.update(_emitters(BRICKS))
