"""Adaptations in lines: how one ended, all that have ended, a plan, a script as a YAML file."""

from collections.abc import Iterator
from typing import Final

import msgspec

from aftbed.adapt.plan import Plan
from aftbed.adapt.scriptfile import phases, step
from aftbed.core.script import Stage, Step, Together

WIDTH: Final = 100
WHEN: Final = {
    "prepare": "while the old one serves",
    "commit": "while the client waits",
    "finish": "when nothing has broken",
}


class Outcome(msgspec.Struct, frozen=True):
    """An adaptation that has ended, as the run tells it; times in milliseconds."""

    number: int
    purpose: str
    recipe: str
    ftm: str
    outcome: str
    reason: str
    asked_ms: float
    prepare_ms: float
    blackout_ms: float
    total_ms: float
    bricks_changed: int
    bricks_total: int


def outcome_lines(run: str, outcome: Outcome) -> Iterator[str]:
    """How an adaptation of `run` ended."""
    yield f"run {run}: {_ended(outcome)}"
    yield (
        f"  prepare {outcome.prepare_ms:.2f} ms, blackout {outcome.blackout_ms:.2f} ms,"
        f" total {outcome.total_ms:.2f} ms; {outcome.bricks_changed} of {outcome.bricks_total} bricks"
    )


def history_lines(outcomes: list[Outcome]) -> Iterator[str]:
    """A line for each adaptation."""
    yield "  #     ASKED    PREPARE   BLACKOUT      TOTAL  BRICKS RECIPE  WHAT"
    for o in outcomes:
        took = " ".join(f"{ms:>7.2f} ms" for ms in (o.prepare_ms, o.blackout_ms, o.total_ms))
        bricks = f"{o.bricks_changed}/{o.bricks_total}"
        yield f"{o.number:>3} {o.asked_ms / 1e3:>7.2f} s {took} {bricks:>7} {o.recipe:7} {_ended(o)}"
    yield f"{len(outcomes)} adaptation{'s' if len(outcomes) != 1 else ''}"


def _ended(outcome: Outcome) -> str:
    why = f": {outcome.reason}" if outcome.reason else ""
    return f"{outcome.purpose}: {outcome.outcome}{why}"


# -- a plan ---------------------------------------------------------------------------------------


def plan_lines(there: Plan, back: Plan) -> Iterator[str]:
    """The plan, its steps, and what the way back takes."""
    yield _headline(there)
    for name in ("replaced", "added", "removed", "rebound", "kept"):
        yield from _listed(name, getattr(there, name))
    for name, verbs in phases(there.script).items():
        yield from _phase(name, verbs)
    yield f"way back, {_headline(back)}"
    yield from _phase("commit", back.script.commit)


def _phase(name: str, verbs: tuple[Step, ...]) -> Iterator[str]:
    if not verbs:
        return
    yield f"{name}, {WHEN[name]}: {len(verbs)} step{'s' if len(verbs) > 1 else ''}"
    for verb in verbs:
        yield from _step_lines(verb, "  ")


def _headline(plan: Plan) -> str:
    return (
        f"{plan.script.purpose}: {plan.bricks_changed} of {plan.bricks_total} bricks"
        f" (placement {plan.new.placement}, recipe {plan.script.recipe})"
    )


def _listed(name: str, bricks: tuple[str, ...]) -> Iterator[str]:
    """`name` and its bricks, in lines of some width."""
    if not bricks:
        return
    line = f"  {name:9}"
    for brick in bricks:
        if len(line) + len(brick) + 1 > WIDTH:
            yield line
            line = " " * 11
        line += f" {brick}"
    yield line


def _step_lines(verb: Step, indent: str) -> Iterator[str]:
    if isinstance(verb, Together):
        yield f"{indent}together"
        for inner in verb.steps:
            yield from _step_lines(inner, indent + "  ")
        return
    ((name, value),) = step(verb).items()
    if isinstance(verb, Stage):
        kinds = ", ".join(f"{b.name} ({b.source or b.application or b.kind})" for b in verb.bricks)
        value = (f"{verb.node}: " if (verb.node,) != tuple(b.name for b in verb.bricks) else "") + kinds
        value += ", held" if verb.held else ""
    yield f"{indent}{name:8} {value}"


# -- YAML -----------------------------------------------------------------------------------------


def yaml_lines(script: dict[str, object]) -> Iterator[str]:
    """A script (`scriptfile.mapping`) as a file: a line for each step, and one for each key beside them."""
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
    import yaml  # noqa: PLC0415 - PyYAML costs 15 ms

    text = yaml.safe_dump(
        value, default_flow_style=True, sort_keys=False, width=float("inf"), allow_unicode=True
    )
    return text.removesuffix("\n").removesuffix("\n...")
