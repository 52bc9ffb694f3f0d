"""A script as a file: an adaptation that a person writes, or reads before it is carried out.

    purpose: lfr inside the paper's pbr, by hand
    ftm: pbr+tr
    prepare:
    - stage: {node: a/tr.before, bricks: {a/tr.before: tr.before}, held: true}
    - bind: a/before.bfr2prd -> a/tr.protocol.pxy2pro
    commit:
    - suspend: a/protocol
    - together:
      - exchange: a/before
      - unbind: a/after.aft2srv
    - resume: a/protocol
    finish:
    - retire: a/proceed

A step is one verb of `core.script` and what it acts on. A port is written behind its brick, `BRICK.PORT`;
both names may have dots, and the longest end that is the name of a port is the port. A brick is written with
its kind, or, where its class or its function was written off line, with `{kind, source, application}`.

`script_from` and `mapping` are inverse to each other. The verbs of Recovery (fence, promote, ...) have no
place in an adaptation, so they have none here. What a script would do to a graph is not judged here: see
`scriptcheck`.
"""

from collections.abc import Callable, Iterable
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from aftbed.core.errors import ConfigError, ScriptError, unknown
from aftbed.core.graph import BrickSpec
from aftbed.core.script import (
    RECIPES,
    Align,
    Attach,
    Bind,
    Destroy,
    Drain,
    Exchange,
    Fence,
    Freeze,
    Kill,
    Migrate,
    Promote,
    Resume,
    Retire,
    Script,
    Spawn,
    Stage,
    Step,
    Suspend,
    Thaw,
    Together,
    Transfer,
    Unbind,
)
from aftbed.ftm.compose import parse
from aftbed.ftm.registry import KINDS

ARROW: Final = "->"
PORTS: Final = tuple(dict.fromkeys(p for kind in KINDS.values() for p in (*kind.inputs, *kind.outputs)))
RECOVERY: Final = ("spawn", "fence", "kill", "promote", "attach")

_ON_ONE: Final[dict[str, Callable[[str], Step]]] = {
    "suspend": Suspend,
    "drain": Drain,
    "resume": Resume,
    "migrate": Migrate,
    "exchange": Exchange,
    "retire": Retire,
    "freeze": Freeze,
    "thaw": Thaw,
    "destroy": Destroy,
}
_ON_TWO: Final[dict[str, Callable[[str, str], Step]]] = {"transfer": Transfer, "align": Align}
VERBS: Final = ("stage", "bind", "unbind", *_ON_TWO, *_ON_ONE, "together")

StepEntry = dict[str, object]  # one verb, and what it acts on


class ScriptFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A script, key by key; what a step may be is checked by `script_from`."""

    purpose: Annotated[str, Meta(min_length=1, max_length=200)]
    commit: tuple[object, ...]
    prepare: tuple[object, ...] = ()
    finish: tuple[object, ...] = ()
    ftm: str = ""
    recipe: Literal["drained", "paper"] = "drained"


class BrickFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A brick whose class or function was written off line."""

    kind: str
    source: str = ""
    application: str = ""


# -- from a script to a file ----------------------------------------------------------------------


def mapping(script: Script) -> dict[str, object]:
    """`script` as a file holds it; what is left out has its default."""
    found: dict[str, object] = {"purpose": script.purpose}
    if script.ftm:
        found["ftm"] = script.ftm
    if script.recipe != RECIPES[0]:
        found["recipe"] = script.recipe
    for name, verbs in phases(script).items():
        if verbs or name == "commit":
            found[name] = [step(verb) for verb in verbs]
    return found


def phases(script: Script) -> dict[str, tuple[Step, ...]]:
    """The steps of `script`, by the name of their phase, in the order in which they are carried out."""
    return {"prepare": script.prepare, "commit": script.commit, "finish": script.finish}


def step(verb: Step) -> StepEntry:
    """One verb as a step of a file."""
    name = type(verb).__name__.lower()
    match verb:
        case Stage():
            return {name: _stage(verb)}
        case Bind(brick, port, target):
            return {name: f"{brick}.{port} {ARROW} {target}.{verb.target_port or port}"}
        case Unbind(brick, port):
            return {name: f"{brick}.{port}"}
        case Transfer(source, sink) | Align(source, sink):
            return {name: f"{source} {ARROW} {sink}"}
        case Together(verbs):
            return {name: [step(inner) for inner in verbs]}
        case Suspend(one) | Drain(one) | Resume(one) | Freeze(one) | Thaw(one):
            return {name: one}
        case Migrate(one) | Exchange(one) | Retire(one) | Destroy(one):
            return {name: one}
        case Spawn() | Fence() | Kill() | Promote() | Attach():
            raise AssertionError(f"{name} has no place in an adaptation")


def words(verb: Step) -> str:
    """One verb in a line, as `suspend a/protocol`."""
    ((name, value),) = step(verb).items()
    return f"{name} {value}"


def _stage(verb: Stage) -> StepEntry:
    found: StepEntry = {"node": verb.node, "bricks": {b.name: _brick(b) for b in verb.bricks}}
    return found | {"held": True} if verb.held else found


def _brick(spec: BrickSpec) -> str | dict[str, str]:
    if not spec.source and not spec.application:
        return spec.kind
    given = {"kind": spec.kind, "source": spec.source, "application": spec.application}
    return {key: value for key, value in given.items() if value}


# -- from a file to a script ----------------------------------------------------------------------


def script_from(file: ScriptFile, where: str) -> Script:
    """The script in `file`; `where` names the file. Raises ScriptError with all that is wrong in it."""
    found: list[str] = []
    if file.ftm:
        try:
            parse(file.ftm)
        except ConfigError as error:
            found.append(f"ftm: {error}")
    prepare = _steps(file.prepare, "prepare", found)
    commit = _steps(file.commit, "commit", found)
    finish = _steps(file.finish, "finish", found)
    refuse(where, found)
    return Script(file.purpose, "", prepare, commit, finish, file.ftm, file.recipe)


def refuse(where: str, problems: list[str]) -> None:
    """Raise a ScriptError with all of `problems`, if there are any."""
    if len(problems) == 1:
        raise ScriptError(f"{where}: {problems[0]}")
    if problems:
        raise ScriptError("\n  ".join((f"{where}: {len(problems)} problems:", *problems)))


def _steps(steps: Iterable[object], where: str, found: list[str]) -> tuple[Step, ...]:
    verbs = []
    for index, entry in enumerate(steps):
        try:
            verbs.append(_verb(entry, f"{where}[{index}]", found))
        except ConfigError as error:
            found.append(str(error))
    return tuple(verbs)


def _verb(entry: object, where: str, found: list[str]) -> Step:
    """The verb of one step. What is wrong inside of `together` is added to `found`."""
    if not isinstance(entry, dict) or len(entry) != 1:
        raise ConfigError(f"{where}: found {entry!r}, allowed is one verb with what it acts on")
    ((verb, value),) = entry.items()
    if verb in RECOVERY:
        raise ConfigError(f"{where}: {verb} is Recovery's; an adaptation has {', '.join(VERBS)}")
    if verb not in VERBS:
        raise ConfigError(f"{where}: {unknown('verb', str(verb), VERBS)}")
    here = f"{where}.{verb}"
    match verb:
        case "stage":
            return _stage_from(value, here)
        case "together":
            return Together(_steps(_list(value, here), here, found))
        case "bind":
            source, sink = _pair(value, here, "BRICK.PORT")
            (brick, port), (target, target_port) = _end(source, here), _end(sink, here)
            return Bind(brick, port, target, "" if port == target_port else target_port)
        case "unbind":
            return Unbind(*_end(_text(value, here, "BRICK.PORT"), here))
        case _ if verb in _ON_TWO:
            return _ON_TWO[verb](*_pair(value, here, "BRICK"))
        case _:
            return _ON_ONE[verb](_text(value, here, "the name of a brick or a node"))


def _stage_from(value: object, where: str) -> Stage:
    given = _keys(value, where, ("node", "bricks", "held"), needed=("node", "bricks"))
    node = _text(given["node"], f"{where}.node", "the name of a node")
    held = given.get("held", False)
    if not isinstance(held, bool):
        raise ConfigError(f"{where}.held: found {held!r}, allowed is true or false")
    bricks = given["bricks"]
    if not isinstance(bricks, dict) or not bricks:
        raise ConfigError(f"{where}.bricks: found {bricks!r}, allowed is BRICK: KIND, once or more")
    return Stage(node, tuple(_brick_from(str(b), v, f"{where}.bricks.{b}") for b, v in bricks.items()), held)


def _brick_from(name: str, value: object, where: str) -> BrickSpec:
    if isinstance(value, dict):
        given = _keys(value, where, BrickFile.__struct_fields__, needed=("kind",))
        texts = {key: _text(one, f"{where}.{key}", "a text") for key, one in given.items()}
        file = BrickFile(**texts)
    else:
        file = BrickFile(_text(value, where, "a kind of brick"))
    if file.kind not in KINDS:
        raise ConfigError(f"{where}: {unknown('kind of brick', file.kind, KINDS)}")
    return BrickSpec(name, file.kind, file.source, file.application)


def _keys(value: object, where: str, allowed: tuple[str, ...], needed: tuple[str, ...]) -> StepEntry:
    if not isinstance(value, dict):
        raise ConfigError(f"{where}: found {value!r}, allowed are the keys {', '.join(allowed)}")
    for key in value:
        if key not in allowed:
            raise ConfigError(f"{where}: {unknown('key', str(key), allowed)}")
    for key in needed:
        if key not in value:
            raise ConfigError(f"{where}: key {key!r} is missing")
    return value


def _list(value: object, where: str) -> list[object]:
    if not isinstance(value, list) or not value:
        raise ConfigError(f"{where}: found {value!r}, allowed is a list of steps")
    return value


def _text(value: object, where: str, allowed: str) -> str:
    if not isinstance(value, str) or not value or value != value.strip():
        raise ConfigError(f"{where}: found {value!r}, allowed is {allowed}")
    return value


def _pair(value: object, where: str, of: str) -> tuple[str, str]:
    both = f"{of} {ARROW} {of}"
    source, arrow, sink = _text(value, where, both).partition(f" {ARROW} ")
    if not arrow or not source.strip() or not sink.strip() or ARROW in sink:
        raise ConfigError(f"{where}: found {value!r}, allowed is {both}")
    return source.strip(), sink.strip()


def _end(text: str, where: str) -> tuple[str, str]:
    """`a/tr.before.bfr2prd` as brick and port."""
    parts = text.split(".")
    for at in range(1, len(parts)):
        brick, port = ".".join(parts[:at]), ".".join(parts[at:])
        if brick and port in PORTS:
            return brick, port
    if len(parts) == 1:
        raise ConfigError(f"{where}: found {text!r}, allowed is BRICK.PORT")
    raise ConfigError(f"{where}: {unknown('port', parts[-1], PORTS)}")
