"""What the commands of `aftbed adapt` do, and `aftbed run --adapt` before it starts.

What can be refused is refused here, before the run is asked: a wrong word, a mechanism that does not suit
the function (`consistency`), a script with a mistake in it. The Engine plans and checks once more, on the
graph that runs when it begins.
"""

import functools
import json
import sys
from pathlib import Path
from typing import Final

import msgspec

from aftbed.adapt import schedule
from aftbed.adapt.engine import script_for
from aftbed.adapt.plan import APPLICATION, Plan, target
from aftbed.adapt.plan import plan as planned
from aftbed.adapt.schedule import goal_of, led_to
from aftbed.adapt.scriptcheck import refusals
from aftbed.adapt.scriptfile import ScriptFile, mapping, refuse, script_from
from aftbed.adapt.suitability import remarks, unsuitable
from aftbed.adapt.words import Wish
from aftbed.cli.adaptview import Outcome, history_lines, outcome_lines, plan_lines, yaml_lines
from aftbed.core.application import Characteristics
from aftbed.core.errors import ConfigError
from aftbed.core.graph import PLACEMENTS, BrickSpec, Graph
from aftbed.core.messages import Goal, Scheduled
from aftbed.core.script import Script, Stage, Step, Together
from aftbed.ftm.compose import build
from aftbed.runtime.unix import ask, rundir

EXIT_CODES: Final = {"done": 0, "rolled back": 1, "refused": 2}


# -- asking a live run ----------------------------------------------------------------------------


def change(run: str | None, wish: Wish, recipe: str, *, force: bool, as_json: bool) -> int:
    """Have `wish` come true in the run; the exit code."""
    private = rundir.find(run)
    graph = _graph_of(private)
    goal = goal_of(wish, graph, recipe, _here)
    _refuse_unsuitable(led_to(graph, goal), wish, force=force)
    return _ask(private, goal, as_json=as_json)


def carry_out(run: str | None, file: str, *, as_json: bool) -> int:
    """Have the run carry out the script in `file`; the exit code."""
    from aftbed.vehicle.yamlfile import read_yaml  # noqa: PLC0415 - PyYAML costs 15 ms

    path = Path(file)
    script = _absolute(script_from(read_yaml(path, ScriptFile), file), path.parent)
    private = rundir.find(run)
    graph = _graph_of(private)
    refuse(file, refusals(graph, script))
    goal = Goal(script=script, recipe=script.recipe)
    script_for(graph, goal)
    return _ask(private, goal, as_json=as_json)


def _graph_of(private: Path) -> Graph:
    return msgspec.convert(ask.ask(private, ask.GraphNow()), Graph)


def _ask(private: Path, goal: Goal, *, as_json: bool) -> int:
    found = ask.ask(private, ask.Adapt(goal), ask.ADAPT_SECONDS_MAX)
    outcome = msgspec.convert(found, Outcome)
    lines = [json.dumps(found)] if as_json else outcome_lines(private.name, outcome)
    print("\n".join(lines))
    return EXIT_CODES[outcome.outcome]


# -- what is asked for ----------------------------------------------------------------------------


def scheduled(texts: tuple[str, ...], start: Graph, recipe: str, *, force: bool) -> tuple[Scheduled, ...]:
    """The adaptations of `--adapt`, each checked on the graph that it will find. Raises ConfigError."""
    judge = functools.partial(_refuse_unsuitable, force=force)
    try:
        return schedule.scheduled(texts, start, recipe, resolve=_here, judge=judge)
    except ConfigError as error:
        raise ConfigError(f"--adapt {error}") from error


def _here(text: str) -> str:
    return _source(text, Path.cwd())


def _source(text: str, folder: Path) -> str:
    """`FILE.py:CLASS` with the whole path of the file. Raises ConfigError if there is no such file."""
    place, colon, name = text.rpartition(":")
    if not (colon and place and name.isidentifier()):
        raise ConfigError(f"{text!r} names no class; MODULE:CLASS or FILE.py:CLASS is allowed")
    if not place.endswith(".py"):
        return text
    path = (folder / place).resolve()
    if not path.is_file():
        raise ConfigError(f"{text}: {path}: no such file")
    return f"{path}:{name}"


def _absolute(script: Script, folder: Path) -> Script:
    """`script` with the whole paths of the files that it names beside itself."""

    def brick(spec: BrickSpec) -> BrickSpec:
        source = _source(spec.source, folder) if spec.source else ""
        application = _source(spec.application, folder) if spec.application else ""
        return msgspec.structs.replace(spec, source=source, application=application)

    def verb(one: Step) -> Step:
        match one:
            case Stage():
                return msgspec.structs.replace(one, bricks=tuple(brick(b) for b in one.bricks))
            case Together(verbs):
                return Together(tuple(verb(inner) for inner in verbs))
            case _:
                return one

    prepare, commit = (tuple(verb(v) for v in steps) for steps in (script.prepare, script.commit))
    return msgspec.structs.replace(script, prepare=prepare, commit=commit)


# -- what suits -----------------------------------------------------------------------------------


def _refuse_unsuitable(new: Graph, wish: Wish, *, force: bool) -> None:
    """Raise ConfigError if the mechanism of `new` does not suit its function, unless `force`."""
    if wish.verb == "decompose" or (wish.verb == "update" and wish.name != APPLICATION):
        return  # no more is needed than what runs needs
    declared = _characteristics(new)
    if reason := unsuitable(new.ftm, declared):
        if not force:
            raise ConfigError(f"{reason}; --force does it all the same")
        print(f"aftbed: forced: {reason}", file=sys.stderr)
    for remark in remarks(new.ftm, declared):
        print(f"aftbed: note: {remark}", file=sys.stderr)


def _characteristics(graph: Graph) -> Characteristics:
    """What the function of `graph` declares. Raises ConfigError if it cannot be had."""
    from aftbed.adapt.bricks import load_application  # noqa: PLC0415
    from aftbed.runtime.unix.part import load_module  # noqa: PLC0415 - 50 ms, where it is needed
    from aftbed.vehicle.aeb.function import default_application  # noqa: PLC0415

    source = next(b.application for b in graph.bricks if b.part == "server")
    function = load_application(source, load_module) if source else default_application()
    declared: object = getattr(function, "characteristics", None)
    if not isinstance(declared, Characteristics):
        raise ConfigError(f"{source}: characteristics: found {declared!r}, allowed is Characteristics(...)")
    return declared


# -- showing --------------------------------------------------------------------------------------


def show_plan(
    run: str | None,
    expression: str,
    start: str | None,
    placement: str | None,
    recipe: str,
    *,
    as_yaml: bool,
    as_json: bool,
) -> None:
    """Print what leads from what runs, or from `start`, to `expression`."""
    if as_yaml and as_json:
        raise ConfigError("--yaml and --json: one of them is allowed")
    if start is None and placement is not None:
        raise ConfigError("--placement says where --from stands: give --from EXPR too")
    old = _graph_of(rundir.find(run)) if start is None else build(start, placement or PLACEMENTS[0])
    there = planned(old, target(old, expression), recipe)
    back = planned(there.new, old, recipe)
    if as_yaml:
        print("\n".join(yaml_lines(mapping(there.script))))
    elif as_json:
        print(json.dumps({**_document(there), "way_back": _document(back)}))
    else:
        print("\n".join(plan_lines(there, back)))


def _document(plan: Plan) -> dict[str, object]:
    return {
        "from": plan.old.ftm,
        "to": plan.new.ftm,
        "placement": plan.new.placement,
        "recipe": plan.script.recipe,
        "bricks_changed": plan.bricks_changed,
        "bricks_total": plan.bricks_total,
        "replaced": plan.replaced,
        "added": plan.added,
        "removed": plan.removed,
        "kept": plan.kept,
        "rebound": plan.rebound,
        "script": mapping(plan.script),
    }


def show_history(run: str | None, *, as_json: bool) -> None:
    """Print the adaptations that have ended."""
    found = ask.ask(rundir.find(run), ask.Adaptations())
    outcomes = msgspec.convert(found["adaptations"], list[Outcome])
    print("\n".join([json.dumps(found)] if as_json else history_lines(outcomes)))
