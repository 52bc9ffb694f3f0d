"""`aftbed adapt`: change the mechanism, a brick or the function of a live run; and `aftbed run --adapt`.

An unknown word, and a mechanism that does not suit the function (`suitability`), are refused here. The run
plans the change on the graph that runs when it begins, checks it, and carries it out or refuses it.
"""

import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, Final

import msgspec
import typer
import yaml

from aftbed.adapt import commands
from aftbed.adapt.commands import Wish, goal_of
from aftbed.adapt.planner import APPLICATION, Plan, target
from aftbed.adapt.planner import plan as plan_between
from aftbed.adapt.script_check import refusals
from aftbed.adapt.script_file import ScriptFile, entry, mapping, phases, refuse, script_from
from aftbed.adapt.suitability import remarks, unsuitable
from aftbed.cli.options import Json, Recipe, Run, choices, class_source, print_json, takes
from aftbed.cli.parsing import PlainGroup
from aftbed.cli.views import EndedAdaptation, history_lines
from aftbed.core.application import Characteristics
from aftbed.core.errors import ConfigError
from aftbed.core.graph import PLACEMENTS, BrickSpec, Graph
from aftbed.core.messages import Goal, Scheduled
from aftbed.core.script import Script, Stage, Step, Together
from aftbed.core.yaml_file import position, read_yaml
from aftbed.ftm.compose import EXPRESSIONS, build, protected_by
from aftbed.functions.source import located
from aftbed.runtime.unix import control_client, run_directory
from aftbed.runtime.unix.trust import versioned
from aftbed.vehicle.aeb.function import default_application

EXIT_CODES: Final = {"done": 0, "rolled back": 1, "refused": 2}
WIDTH: Final = 100
WHEN: Final = {
    "prepare": "while the old one serves",
    "commit": "while the client waits",
    "finish": "when nothing has broken",
}


class AdaptGroup(PlainGroup):
    """Knows the verbs by what others call them; a mechanism alone is what to adapt to."""

    MEANT: ClassVar[Mapping[str, str]] = {**commands.SYNONYMS, **dict.fromkeys(EXPRESSIONS, "to")}


adapt = typer.Typer(cls=AdaptGroup)

Expr = Annotated[str, typer.Argument(help="The whole new expression, the outer mechanism first: lfr+tr.")]
MayFail = Annotated[
    bool, typer.Option("--may-fail", help="The run may pass even if this is rolled back or refused.")
]
Force = Annotated[bool, typer.Option("--force", help="Even where it does not suit the function.")]


# -- change a live run ----------------------------------------------------------------------------


class ChangeArguments(msgspec.Struct, frozen=True, kw_only=True):
    """The options of `aftbed adapt to`, `switch` and `compose`."""

    expr: Expr
    recipe: Recipe = "drained"
    force: Force = False
    may_fail: MayFail = False
    run: Run = None
    json: Json = False


def _change_command(verb: str, about: str) -> None:
    @adapt.command(verb, help=about)
    @takes(ChangeArguments)
    def change(given: ChangeArguments) -> int:
        return _change(Wish(verb, given.expr), given)


EXIT_HELP: Final = "Exit code of all that adapts: 0 done, 1 rolled back, 2 refused."
_change_command("to", f"Replace what runs by EXPR.\n\n{EXIT_HELP}")
_change_command("switch", "Replace the outer mechanism by another one.")
_change_command("compose", "Keep the outer mechanism, and add mechanisms inside it.")


@adapt.command()
def decompose(
    recipe: Recipe = "drained", may_fail: MayFail = False, run: Run = None, json: Json = False
) -> None:
    """Keep the outer mechanism, and remove those inside it."""
    given = ChangeArguments(expr="", recipe=recipe, may_fail=may_fail, run=run, json=json)
    raise typer.Exit(_change(Wish("decompose"), given))


@adapt.command()
def update(
    brick: Annotated[str, typer.Argument(help="A brick of a replica, as tr.after; app is the function.")],
    source: Annotated[str, typer.Option("--to", help="MODULE:CLASS or FILE.py:CLASS.")],
    recipe: Recipe = "drained",
    force: Force = False,
    may_fail: MayFail = False,
    run: Run = None,
    json: Json = False,
) -> None:
    """Replace the class of one brick on every replica; the class may be newer than the run.

    To load it and to test it with recorded requests may take 5 s; then the adaptation is refused.
    """
    given = ChangeArguments(expr="", recipe=recipe, force=force, may_fail=may_fail, run=run, json=json)
    raise typer.Exit(_change(Wish("update", brick, source), given))


@adapt.command()
def script(
    file: Annotated[str, typer.Argument(help="A YAML file, as `adapt plan --yaml` prints it.")],
    may_fail: MayFail = False,
    run: Run = None,
    json: Json = False,
) -> None:
    """Carry out a script from a file; all of it is checked before its first step."""
    path = Path(file)
    found = script_from(read_yaml(path, ScriptFile), file, partial(position, path))
    wanted, private = _absolute(found, path.parent), run_directory.find(run)
    graph = msgspec.convert(control_client.ask(private, control_client.GraphQuery()), Graph)
    # As the run itself does, which does not know the lines of the file.
    wrong = refusals(graph, wanted)
    refuse(file, [f"{position(path, one.place) if one.place else ''}{one}" for one in wrong])
    goal = Goal(script=wanted, recipe=wanted.recipe, file=file, may_fail=may_fail)
    raise typer.Exit(_ask(private, goal, as_json=json))


def _change(wish: Wish, given: ChangeArguments) -> int:
    private = run_directory.find(given.run)
    graph = msgspec.convert(control_client.ask(private, control_client.GraphQuery()), Graph)
    status = control_client.ask(private, control_client.StatusQuery())

    def found_now(wish: Wish) -> str:
        source = found_source(wish)
        return versioned(source, Path(str(status["record"]))) if wish.name == APPLICATION else source

    goal = msgspec.structs.replace(goal_of(wish, graph, given.recipe, found_now), may_fail=given.may_fail)
    _refuse_unsuitable(commands.plan_goal(graph, goal).new, wish, force=given.force)
    return _ask(private, goal, as_json=given.json)


def _ask(private: Path, goal: Goal, *, as_json: bool) -> int:
    """Have the run adapt, print how it ended; the exit code."""
    found = control_client.ask(private, control_client.AdaptCommand(goal), control_client.ADAPT_SECONDS_MAX)
    ended = msgspec.convert(found, EndedAdaptation)
    if as_json:
        print_json(found)
    else:
        print(f"run {private.name}: {ended}")
        print(
            f"  prepare {ended.prepare_ms:.2f} ms, blackout {ended.blackout_ms:.2f} ms,"
            f" total {ended.total_ms:.2f} ms; {ended.bricks_changed} of {ended.bricks_total} bricks"
        )
    return EXIT_CODES[ended.outcome]


# -- what is refused before the run is asked ------------------------------------------------------


def scheduled(
    texts: tuple[str, ...], start: Graph, recipe: str, *, force: bool, may_fail: bool = False
) -> tuple[Scheduled, ...]:
    """The adaptations of `--adapt`, each checked on the graph that it will find. Raises ConfigError."""

    def judge(new: Graph, wish: Wish) -> None:
        _refuse_unsuitable(new, wish, force=force)

    try:
        return commands.scheduled(texts, start, recipe, resolve=found_source, judge=judge, may_fail=may_fail)
    except ConfigError as error:
        raise ConfigError(f"--adapt {error}") from error


def found_source(wish: Wish) -> str:
    """Where the class, or the function, of an update is found. Raises ConfigError."""
    return located(wish.source) if wish.name == APPLICATION else class_source(wish.source)


def _refuse_unsuitable(new: Graph, wish: Wish, *, force: bool) -> None:
    """The same of `new`, to which `wish` leads."""
    if wish.verb == "decompose" or (wish.verb == "update" and wish.name != APPLICATION):
        return  # the new graph needs no more of the function than the old one
    refuse_unsuitable(protected_by(new), new.ftm, force=force)


def refuse_unsuitable(
    application: str, *ftms: str, force: bool, requests: Sequence[bytes] | None = None
) -> None:
    """Raise ConfigError if one of `ftms` does not suit the function, unless `force`.

    With `requests`, the function of a user is tried out with them, and refused likewise if it fails. It is
    loaded neither here nor in the supervisor.
    """
    if not application:
        declared = default_application().characteristics
    elif requests is None:
        declared = declared_in_time(application)
    else:
        declared = tried_out(application, requests, force=force)
    for ftm in ftms:
        if reason := unsuitable(ftm, declared):
            if not force:
                raise ConfigError(f"{reason}; --force does it all the same")
            print(f"aftbed: forced: {reason}", file=sys.stderr)
        for remark in remarks(ftm, declared):
            print(f"aftbed: note: {remark}", file=sys.stderr)


def tried_out(application: str, requests: Sequence[bytes], *, force: bool) -> Characteristics:
    """What the function of a user declares, which is tried out with `requests`.

    Raises ConfigError if it fails; with `force`, only where what it declares is not known.
    """
    from aftbed.judge import isolated  # noqa: PLC0415 - as below
    from aftbed.runtime.unix.trust import OWN_RUN  # noqa: PLC0415

    try:
        found = isolated.tried_out(application, requests, OWN_RUN)
    except ConfigError as error:
        if not force:
            raise
        declared = declared_in_time(application)
        print(f"aftbed: forced: {error}", file=sys.stderr)
        return declared
    if found.otherwise:
        print(f"aftbed: note: {application}: {found.otherwise}", file=sys.stderr)
    return found.characteristics


def declared_in_time(application: str) -> Characteristics:
    """Its process has as long as the run's processes will have. Raises ConfigError."""
    # Imported here: no run waits for a judge at its start.
    from aftbed.judge.isolated import LIMITS, declared_by  # noqa: PLC0415
    from aftbed.runtime.script_executor import STAGE_SECONDS_MAX  # noqa: PLC0415
    from aftbed.runtime.unix.trust import OWN_RUN  # noqa: PLC0415

    return declared_by(application, OWN_RUN, msgspec.structs.replace(LIMITS, seconds=STAGE_SECONDS_MAX))


def _absolute(script: Script, folder: Path) -> Script:
    """`script`, with the classes that it names resolved against `folder`."""

    def brick(spec: BrickSpec) -> BrickSpec:
        source = class_source(spec.source, folder) if spec.source else ""
        application = located(spec.application, folder) if spec.application else ""
        return msgspec.structs.replace(spec, source=source, application=application)

    def resolved(verb: Step) -> Step:
        match verb:
            case Stage():
                return msgspec.structs.replace(verb, bricks=tuple(brick(b) for b in verb.bricks))
            case Together(steps):
                return Together(tuple(resolved(inner) for inner in steps))
            case _:
                return verb

    prepare, commit = (tuple(resolved(v) for v in steps) for steps in (script.prepare, script.commit))
    return msgspec.structs.replace(script, prepare=prepare, commit=commit)


# -- a plan that is only shown --------------------------------------------------------------------


@adapt.command()
def plan(
    expr: Expr,
    start: Annotated[
        str | None, typer.Option("--from", help="From this mechanism; without it, from what runs.")
    ] = None,
    placement: Annotated[
        str | None, typer.Option(metavar=choices(PLACEMENTS), help="With --from; process if left out.")
    ] = None,
    recipe: Recipe = "drained",
    run: Run = None,
    as_yaml: Annotated[bool, typer.Option("--yaml", help="Print the script as a file.")] = False,
    json: Json = False,
) -> None:
    """Show the steps of an adaptation to EXPR, and the way back. Nothing is changed."""
    if as_yaml and json:
        raise ConfigError("--yaml and --json: one of them is allowed")
    if start is None and placement is not None:
        raise ConfigError("--placement belongs to --from: give --from EXPR too")
    if start is None:
        goal = control_client.PlanQuery(Goal(expression=expr, recipe=recipe))
        planned = msgspec.convert(
            control_client.ask(run_directory.find(run), goal), control_client.PlanAnswer
        )
        there, back = planned.there, planned.back
    else:
        old = build(start, placement or PLACEMENTS[0])
        there = plan_between(old, target(old, expr), recipe)
        back = plan_between(there.new, old, recipe)
    if as_yaml:
        print("\n".join(yaml_lines(mapping(there.script))))
    elif json:
        print_json({**_document(there), "way_back": _document(back)})
    else:
        print("\n".join(_plan_lines(there, back)))


PLAN_PARTS: Final = ("replaced", "added", "removed", "rebound", "kept")  # bricks of a plan


def _document(plan: Plan) -> dict[str, object]:
    return {
        "from": plan.old.ftm,
        "to": plan.new.ftm,
        "placement": plan.new.placement,
        "recipe": plan.script.recipe,
        "bricks_changed": plan.bricks_changed,
        "bricks_total": plan.bricks_total,
        **{name: getattr(plan, name) for name in PLAN_PARTS},
        "script": mapping(plan.script),
    }


def _plan_lines(there: Plan, back: Plan) -> Iterator[str]:
    """The plan, its steps, and the commit of the way back."""
    yield _headline(there)
    for name in PLAN_PARTS:
        yield from _wrapped(name, getattr(there, name))
    for name, verbs in phases(there.script).items():
        yield from _phase(name, verbs)
    yield f"way back, {_headline(back)}"
    yield from _phase("commit", back.script.commit)


def _headline(plan: Plan) -> str:
    return (
        f"{plan.script.purpose}: {plan.bricks_changed} of {plan.bricks_total} bricks"
        f" (placement {plan.new.placement}, recipe {plan.script.recipe})"
    )


def _wrapped(name: str, bricks: tuple[str, ...]) -> list[str]:
    """`name` and its bricks, in lines of at most WIDTH characters."""
    indent = " " * 12
    return (
        textwrap.wrap(
            f"  {name:9} {' '.join(bricks)}",
            WIDTH,
            subsequent_indent=indent,
            drop_whitespace=True,
            break_on_hyphens=False,
            break_long_words=False,
        )
        if bricks
        else []
    )


def _phase(name: str, verbs: tuple[Step, ...]) -> Iterator[str]:
    if not verbs:
        return
    yield f"{name}, {WHEN[name]}: {len(verbs)} step{'s' if len(verbs) > 1 else ''}"
    for verb in verbs:
        yield from _step_lines(verb, "  ")


def _step_lines(verb: Step, indent: str) -> Iterator[str]:
    if isinstance(verb, Together):
        yield f"{indent}together"
        for inner in verb.steps:
            yield from _step_lines(inner, indent + "  ")
        return
    ((name, value),) = entry(verb).items()
    if isinstance(verb, Stage):
        kinds = ", ".join(f"{b.name} ({b.source or b.application or b.kind})" for b in verb.bricks)
        value = (f"{verb.node}: " if (verb.node,) != tuple(b.name for b in verb.bricks) else "") + kinds
        value += ", held" if verb.held else ""
    yield f"{indent}{name:8} {value}"


def yaml_lines(script: dict[str, object]) -> Iterator[str]:
    """A script (`script_file.mapping`) as a YAML file: a line for each key and each step."""
    for key, value in script.items():
        if isinstance(value, list):
            yield f"{key}:" if value else f"{key}: []"
            yield from _yaml_steps(value, "")
        else:
            yield f"{key}: {_yaml(value)}"


def _yaml_steps(steps: list[dict[str, object]], indent: str) -> Iterator[str]:
    for one in steps:
        ((verb, value),) = one.items()
        if isinstance(value, list):
            yield f"{indent}- {verb}:"
            yield from _yaml_steps(value, indent + "  ")
        else:
            yield f"{indent}- {verb}: {_yaml(value)}"


def _yaml(value: object) -> str:
    """One value, in one line."""
    text = yaml.safe_dump(
        value, default_flow_style=True, sort_keys=False, width=float("inf"), allow_unicode=True
    )
    return text.removesuffix("\n").removesuffix("\n...")


# -- adaptations that ended -----------------------------------------------------------------------


@adapt.command()
def history(run: Run = None, json: Json = False) -> None:
    """The adaptations of the run that have ended, and how."""
    found = control_client.ask(run_directory.find(run), control_client.AdaptationsQuery())
    ended = msgspec.convert(found["adaptations"], list[EndedAdaptation])
    if json:
        print_json(found)
    else:
        print("\n".join(history_lines(ended)))
