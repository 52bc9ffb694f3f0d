"""`aftbed schema KIND`: the JSON Schema of a kind of YAML file, for editors that complete and check by it.

A schema is made of the types by which the file is read, so it cannot say anything else. What a key means
stands at the key in the source: the comment behind it, or a sentence of the docstring that begins with the
key. Which keys go together, and which names exist, is checked when the file is read, and no schema says it.
"""

import importlib
import inspect
import re
from collections.abc import Iterator
from typing import Annotated, Any, Final, get_args

import msgspec
import typer

from aftbed.cli.options import Json, print_json
from aftbed.core.errors import unknown

SHAPES: Final = {  # kind of file: MODULE:TYPE below aftbed, what it is
    "scenario": ("vehicle.scenarios.scenario:ScenarioKeys", "A drive: aftbed run --scenario FILE."),
    "campaign": ("campaign.spec:Spec", "Experiments in numbers: aftbed campaign run FILE."),
    "map": ("vehicle.replay.map_file:MapFile", "How a radar reports: aftbed run --replay LOG --map FILE."),
    "policy": ("adapt.policy:PolicyFile", "When to adapt what: aftbed run --policy FILE."),
    "script": ("adapt.script_file:ScriptFile", "An adaptation, step by step: aftbed adapt script FILE."),
    "ports": ("functions.ports:PortsFile", "Variables of an FMU: --app MODEL.fmu:FILE."),
    "table": ("adapt.suitability:TableFile", "What mechanisms need: aftbed ftm check --table FILE."),
}
DIALECT: Final = "http://json-schema.org/draft-07/schema#"  # what the YAML extension of VS Code knows best
_FIELD: Final = re.compile(r" {4}(?P<key>\w+): [^#\n]*(?:# (?P<about>.*))?$")
_MEANING: Final = re.compile(r"(?:^|[.;:] )(?=(?:`\w+`, )*`\w+`: )")

Schema = dict[str, Any]


KIND_HELP: Final = f"{', '.join(SHAPES)}; a list of them if left out."


def schema(
    kind: Annotated[str | None, typer.Argument(help=KIND_HELP)] = None,
    json: Json = False,
) -> None:
    """The JSON Schema of a kind of YAML file, for editors."""
    if kind is None and json:
        print_json({"kinds": {name: about for name, (_, about) in SHAPES.items()}})
    elif kind is None:
        for name, (_, about) in SHAPES.items():
            print(f"{name:<10} {about}")
    else:
        print(schema_text(kind))


def schema_text(kind: str) -> str:
    """The schema of the kind as a file has it. Raises ConfigError."""
    return msgspec.json.format(msgspec.json.encode(schema_of(kind)), indent=1).decode()


def schema_of(kind: str) -> Schema:
    """The schema of the kind. Raises ConfigError."""
    if kind not in SHAPES:
        raise unknown("kind of file", kind, SHAPES)
    shape = shape_of(kind)
    any_value = {"$ref": "#/definitions/Step"} if kind == "script" else {"description": "any value"}
    (top,), parts = msgspec.json.schema_components(
        (shape,), schema_hook=lambda _: any_value, ref_template="#/definitions/{name}"
    )
    if kind == "script":
        from aftbed.adapt.script_file import STEP_SCHEMA  # noqa: PLC0415 - of this kind only

        parts["Step"] = STEP_SCHEMA
    for one in structs_of(shape):
        _describe(parts[one.__name__], one)
    _to_draft_07(parts)
    return {"$schema": DIALECT, "title": f"aftbed {kind}", "definitions": parts, **top}


def shape_of(kind: str) -> type[msgspec.Struct]:
    """The type by which the file is read."""
    module, _, name = SHAPES[kind][0].partition(":")
    found: type[msgspec.Struct] = getattr(importlib.import_module(f"aftbed.{module}"), name)
    return found


def structs_of(kind: object, known: set[object] | None = None) -> Iterator[type[msgspec.Struct]]:
    """`kind` and all structs in it, each once."""
    known = set() if known is None else known
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct) and kind not in known:
        known.add(kind)
        yield kind
        for field in msgspec.structs.fields(kind):
            yield from structs_of(field.type, known)
    for part in get_args(kind):
        yield from structs_of(part, known)


def _describe(part: Schema, kind: type[msgspec.Struct]) -> None:
    """Add the meaning of each key to the schema of a struct, as its source has it."""
    for key, about in meanings(kind).items():
        if key in part["properties"]:
            part["properties"][key] = _with_meaning(part["properties"][key], about)
    if "description" in part:
        part["description"] = " ".join(part["description"].split())


def _to_draft_07(part: object) -> None:
    """msgspec writes a tuple of a fixed length in the words of a later draft."""
    if isinstance(part, dict):
        if "prefixItems" in part:
            part["items"] = part.pop("prefixItems")
            part["additionalItems"] = False
        part = list(part.values())
    if isinstance(part, list):
        for inner in part:
            _to_draft_07(inner)


def _with_meaning(found: Schema, about: str) -> Schema:
    """draft-07 ignores what stands beside a $ref, so that goes into an allOf."""
    if "$ref" in found:
        reference = {"$ref": found.pop("$ref")}
        return {"description": about, "allOf": [reference], **found}
    return {"description": about, **found}


def meanings(kind: type[msgspec.Struct]) -> dict[str, str]:
    """What each key of the struct means; a key of which the source says nothing is left out."""
    found: dict[str, str] = {}
    for one in reversed(kind.__mro__[: kind.__mro__.index(msgspec.Struct)]):
        for sentence in _MEANING.split(" ".join((one.__doc__ or "").split())):
            keys, colon, about = sentence.partition("`: ")
            if colon and keys.startswith("`"):
                found |= dict.fromkeys(re.findall(r"\w+", keys), about.rstrip(".") + ".")
        for line in inspect.getsource(one).splitlines():
            if (field := _FIELD.match(line)) and field["about"] and not field["about"].startswith("noqa"):
                found[field["key"]] = field["about"]
    return found
