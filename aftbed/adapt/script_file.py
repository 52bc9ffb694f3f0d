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
place in an adaptation, so they have none here. Whether the script suits a graph is for `script_check`.
"""

from collections.abc import Callable, Iterable
from typing import Annotated, Final, Literal, cast, get_args

import msgspec
from msgspec import Meta

from aftbed.core.errors import ConfigError, FileKeyError, ScriptError, unknown
from aftbed.core.graph import BrickSpec, Link
from aftbed.core.script import (
    RECIPES,
    Align,
    Bind,
    Script,
    Stage,
    Step,
    Together,
    Transfer,
    Unbind,
    names,
    verb_of,
)
from aftbed.ftm.compose import parse
from aftbed.ftm.registry import KINDS

ARROW: Final = "->"
RECOVERY: Final = ("spawn", "fence", "kill", "promote", "attach")
VERBS: Final[dict[str, type[Step]]] = {
    verb_of(step): step for step in get_args(Step) if verb_of(step) not in RECOVERY
}

StepEntry = dict[str, object]  # one verb, and what it acts on
_TEXT: Final = {"type": "string"}
_OBJECTS: Final[dict[type[Step], dict[str, object]]] = {  # as JSON Schema; of all other verbs it is a text
    Stage: {
        "type": "object",
        "properties": {
            "node": _TEXT,
            "bricks": {
                "type": "object",
                "minProperties": 1,
                "additionalProperties": {
                    "anyOf": [
                        _TEXT,
                        {
                            "type": "object",
                            "properties": {"kind": _TEXT, "source": _TEXT, "application": _TEXT},
                            "required": ["kind"],
                            "additionalProperties": False,
                        },
                    ]
                },
            },
            "held": {"type": "boolean"},
        },
        "required": ["node", "bricks"],
        "additionalProperties": False,
    },
    Together: {"type": "array", "minItems": 1, "items": {"$ref": "#/definitions/Step"}},
}
STEP_SCHEMA: Final[dict[str, object]] = {
    "description": "One verb with what it acts on.",
    "type": "object",
    "properties": {verb: _OBJECTS.get(step, _TEXT) for verb, step in VERBS.items()},
    "minProperties": 1,
    "maxProperties": 1,
    "additionalProperties": False,
}


class ScriptFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A script, key by key; what a step may be is checked by `script_from`."""

    purpose: Annotated[str, Meta(min_length=1, max_length=200)]  # in a line, for people
    commit: tuple[object, ...]  # steps while requests wait
    prepare: tuple[object, ...] = ()  # steps beside what serves
    finish: tuple[object, ...] = ()  # steps once requests are served again
    ftm: str = ""  # the mechanism that it leads to; none: that which runs
    recipe: Literal["drained", "paper"] = "drained"  # paper: SIGSTOP, kill, launch, link, SIGCONT


# -- from a script to a file ----------------------------------------------------------------------


def mapping(script: Script) -> dict[str, object]:
    """`script` as a file holds it; what is left out has its default."""
    found: dict[str, object] = {"purpose": script.purpose}
    if script.ftm:
        found["ftm"] = script.ftm
    if script.recipe != RECIPES[0]:
        found["recipe"] = script.recipe
    for phase, steps in phases(script).items():
        if steps or phase == "commit":
            found[phase] = [entry(step) for step in steps]
    return found


def phases(script: Script) -> dict[str, tuple[Step, ...]]:
    """The steps of `script`, by the name of their phase, in the order in which they are carried out."""
    return {"prepare": script.prepare, "commit": script.commit, "finish": script.finish}


def entry(step: Step) -> StepEntry:
    """One step as a file holds it."""
    verb = verb_of(step)
    assert verb in VERBS, f"{verb} has no place in an adaptation"
    value: object
    match step:
        case Stage(node, bricks, held):
            kinds = {b.name: _brick(b) for b in bricks}
            value = {"node": node, "bricks": kinds, **({"held": True} if held else {})}
        case Bind():
            value = link_words(step.link)
        case Unbind(brick, port):
            value = f"{brick}.{port}"
        case Together(steps):
            value = [entry(inner) for inner in steps]
        case _:
            value = f" {ARROW} ".join(names(step))
    return {verb: value}


def step_words(step: Step) -> str:
    """One step in a line, as `suspend a/protocol`."""
    ((verb, value),) = entry(step).items()
    return f"{verb} {value}"


def link_words(link: Link) -> str:
    """As behind `bind`."""
    return f"{link.source}.{link.source_port} {ARROW} {link.sink}.{link.sink_port}"


def _brick(spec: BrickSpec) -> str | dict[str, str]:
    given = {"kind": spec.kind, "source": spec.source, "application": spec.application}
    return (
        {key: text for key, text in given.items() if text} if spec.source or spec.application else spec.kind
    )


# -- from a file to a script ----------------------------------------------------------------------


def script_from(file: ScriptFile, where: str, position: Callable[[str], str] = lambda key: "") -> Script:
    """The script in `file`; `where` names the file. Raises ScriptError with all that is wrong in it.

    `position` says where a key stands in the file.
    """
    problems: list[FileKeyError] = []
    if file.ftm:
        try:
            parse(file.ftm)
        except ConfigError as error:
            problems.append(FileKeyError("ftm", error))
    prepare = _steps(file.prepare, "prepare", problems)
    commit = _steps(file.commit, "commit", problems)
    finish = _steps(file.finish, "finish", problems)
    refuse(where, [f"{position(one.key)}{one}" for one in problems])
    return Script(file.purpose, "", prepare, commit, finish, file.ftm, file.recipe)


def refuse(where: str, problems: list[str]) -> None:
    """Raise a ScriptError with all of `problems`, if there are any."""
    if len(problems) == 1:
        raise ScriptError(f"{where}: {problems[0]}")
    if problems:
        raise ScriptError("\n  ".join((f"{where}: {len(problems)} problems:", *problems)))


def _steps(entries: Iterable[object], where: str, problems: list[FileKeyError]) -> tuple[Step, ...]:
    """Adds what is wrong to `problems`."""
    found = []
    for index, one in enumerate(entries):
        try:
            found.append(_step(one, f"{where}[{index}]", problems))
        except FileKeyError as error:
            problems.append(error)
    return tuple(found)


def _step(found: object, where: str, problems: list[FileKeyError]) -> Step:
    if not isinstance(found, dict) or len(found) != 1:
        raise FileKeyError(where, f"found {found!r}, allowed is one verb with what it acts on")
    ((verb, value),) = found.items()
    if verb in RECOVERY:
        raise FileKeyError(where, f"{verb} is Recovery's; an adaptation has {', '.join(VERBS)}")
    if verb not in VERBS:
        raise FileKeyError(where, unknown("verb", str(verb), VERBS))
    kind, where = VERBS[verb], f"{where}.{verb}"
    if kind is Stage:
        return _stage(value, where)
    if kind is Together:
        if not isinstance(value, list) or not value:
            raise FileKeyError(where, f"found {value!r}, allowed is a list of steps")
        return Together(_steps(value, where, problems))
    if kind is Bind:
        ends = _pair(value, where, "BRICK.PORT")
        (brick, port), (target, target_port) = (_end(text, where) for text in ends)
        return Bind(brick, port, target, "" if port == target_port else target_port)
    if kind is Unbind:
        return Unbind(*_end(_text(value, where, "BRICK.PORT"), where))
    if kind is Transfer or kind is Align:
        return kind(*_pair(value, where, "BRICK"))
    return cast("Callable[[str], Step]", kind)(_text(value, where, "the name of a brick or a node"))


def _stage(value: object, where: str) -> Stage:
    given = _keys(value, where, ("node", "bricks", "held"), needed=("node", "bricks"))
    node, bricks, held = given["node"], given["bricks"], given.get("held", False)
    node = _text(node, f"{where}.node", "the name of a node")
    if not isinstance(held, bool):
        raise FileKeyError(f"{where}.held", f"found {held!r}, allowed is true or false")
    if not isinstance(bricks, dict) or not bricks:
        raise FileKeyError(f"{where}.bricks", f"found {bricks!r}, allowed is BRICK: KIND, once or more")
    specs = [_brick_spec(str(name), one, f"{where}.bricks.{name}") for name, one in bricks.items()]
    return Stage(node, tuple(specs), held)


def _brick_spec(name: str, value: object, where: str) -> BrickSpec:
    if isinstance(value, dict):
        given = _keys(value, where, ("kind", "source", "application"), needed=("kind",))
        texts = {key: _text(one, f"{where}.{key}", "a text") for key, one in given.items()}
    else:
        texts = {"kind": _text(value, where, "a kind of brick")}
    if texts["kind"] not in KINDS:
        raise FileKeyError(where, unknown("kind of brick", texts["kind"], KINDS))
    return BrickSpec(name, **texts)


def port_names() -> tuple[str, ...]:
    """Of all kinds of bricks that are known here: the mechanism of the script is."""
    return tuple(dict.fromkeys(p for kind in KINDS.values() for p in (*kind.inputs, *kind.outputs)))


def _keys(value: object, where: str, allowed: tuple[str, ...], needed: tuple[str, ...]) -> StepEntry:
    if not isinstance(value, dict):
        raise FileKeyError(where, f"found {value!r}, allowed are the keys {', '.join(allowed)}")
    for key in value:
        if key not in allowed:
            raise FileKeyError(where, unknown("key", str(key), allowed))
    for key in needed:
        if key not in value:
            raise FileKeyError(where, f"key {key!r} is missing")
    return value


def _text(value: object, where: str, allowed: str) -> str:
    if not isinstance(value, str) or not value or value != value.strip():
        raise FileKeyError(where, f"found {value!r}, allowed is {allowed}")
    return value


def _pair(value: object, where: str, of: str) -> tuple[str, str]:
    both = f"{of} {ARROW} {of}"
    source, arrow, sink = _text(value, where, both).partition(f" {ARROW} ")
    if not arrow or not source.strip() or not sink.strip() or ARROW in sink:
        raise FileKeyError(where, f"found {value!r}, allowed is {both}")
    return source.strip(), sink.strip()


def _end(text: str, where: str) -> tuple[str, str]:
    """`a/tr.before.bfr2prd` as brick and port."""
    parts = text.split(".")
    for at in range(1, len(parts)):
        brick, port = ".".join(parts[:at]), ".".join(parts[at:])
        if brick and port in port_names():
            return brick, port
    if len(parts) == 1:
        raise FileKeyError(where, f"found {text!r}, allowed is BRICK.PORT")
    raise FileKeyError(where, unknown("port", parts[-1], port_names()))
