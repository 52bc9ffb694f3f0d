"""The words of an adaptation, the same on `run --adapt "..."` and on `aftbed adapt ...`.

    to EXPR | switch EXPR | compose EXPR | decompose | update BRICK to SOURCE   [at request 120 | after 500ms]

EXPR is always the whole of what will run. `to` leads anywhere. The other verbs say besides what kind of
change is meant, so that a slip is refused, with the verb named that would do it:

| verb      | the outer mechanism | inside                                  |
|-----------|---------------------|-----------------------------------------|
| switch    | becomes another     | whatever EXPR has                       |
| compose   | is the running one  | all that is there, in order, and more   |
| decompose | is the running one  | nothing any more                        |

`update` exchanges the class of one brick on every replica; the brick `app` is the protected function.
Without a word about when, an adaptation begins at once.
"""

import contextlib
import re
from collections.abc import Callable
from typing import Final

import msgspec

from aftbed.adapt.planner import APPLICATION, Plan, plan, plan_of, target, updated
from aftbed.adapt.script_check import refusals
from aftbed.adapt.script_file import refuse
from aftbed.core.errors import ConfigError, ScriptError, unknown
from aftbed.core.graph import Graph
from aftbed.core.messages import Goal, Scheduled
from aftbed.core.script import RECIPES, after
from aftbed.core.units import milliseconds
from aftbed.ftm.compose import canonical, parse, replicates
from aftbed.ftm.registry import KINDS

VERBS: Final = ("to", "switch", "compose", "decompose", "update")
SYNONYMS: Final = {  # of verbs
    **dict.fromkeys(("add", "insert", "with"), "compose"),
    **dict.fromkeys(("remove", "drop", "without"), "decompose"),
    **dict.fromkeys(("change", "replace", "swap"), "switch"),
    **dict.fromkeys(("upgrade", "patch", "reload"), "update"),
    **dict.fromkeys(("adapt", "goto", "go"), "to"),
}
GRAMMAR: Final = (
    "to|switch|compose EXPR, decompose, or update BRICK to SOURCE, then [at request N | after 500ms]"
)
TIMES: Final = ("at", "after")  # begin the words about when
_WHOLE: Final = re.compile(r"[0-9]{1,12}")


class Wish(msgspec.Struct, frozen=True):
    """An adaptation as it was asked for: `name` is an expression, or a brick that is to become `source`."""

    verb: str
    name: str = ""
    source: str = ""

    def __str__(self) -> str:
        to = f" to {self.source}" if self.source else ""
        return f"{self.verb} {self.name}".strip() + to


class Timed(msgspec.Struct, frozen=True):
    """When a wish begins: when request `at_request` is sent, or `after_ms` after the launch; 0 is unsaid."""

    wish: Wish
    at_request: int = 0
    after_ms: float = 0.0


def read(text: str) -> Timed:
    """The adaptation that `text` means. Raises ConfigError naming the word that is wrong."""
    words = text.split()
    if not words:
        raise ConfigError(f"adaptation {text!r}: expected {GRAMMAR}")
    verb, *rest = words
    if verb not in VERBS:
        raise _no_verb(verb)
    length = {"decompose": 0, "update": 3}.get(verb, 1)
    if len(rest) < length or (verb == "update" and rest[1] != "to"):
        raise ConfigError(f"adaptation {text!r}: expected {GRAMMAR}")
    if verb == "update" and rest[0] == APPLICATION:  # a command line has several words
        length = next((at for at in range(3, len(rest)) if rest[at] in TIMES), len(rest))
    name = rest[0] if length else ""
    source = " ".join(rest[2:length]) if verb == "update" else ""
    wish = Wish(verb, name, source)
    match rest[length:]:
        case []:
            return Timed(wish)
        case ["at", "request", number]:
            if not (_WHOLE.fullmatch(number) and int(number) >= 1):
                raise ConfigError(f"at request {number[:40]!r}: a whole number from 1 on is allowed")
            return Timed(wish, at_request=int(number))
        case ["after", duration]:
            return Timed(wish, after_ms=milliseconds("after", duration))
        case words:
            found = " ".join(words)
            meant = f"; did you mean 'after {words[1]}'?" if words[0] == "at" and len(words) == 2 else ""
            raise ConfigError(f"found {found!r}, allowed is 'at request N' or 'after 500ms'{meant}")


def _no_verb(word: str) -> ConfigError:
    with contextlib.suppress(ConfigError):
        return ConfigError(f"{word!r} says not how: did you mean 'to {canonical(word)}'? ({GRAMMAR})")
    return unknown("adaptation", word, VERBS, SYNONYMS)


def goal(wish: Wish, running: str, recipe: str = RECIPES[0]) -> Goal:
    """What `wish` comes to where `running` runs. Raises ConfigError, naming the verb that would do."""
    if recipe not in RECIPES:
        raise unknown("recipe", recipe, RECIPES)
    if wish.verb == "update":
        return Goal(part=wish.name, source=wish.source, recipe=recipe)
    old = parse(running)
    if wish.verb == "decompose":
        if len(old) < 2:
            raise ConfigError(f"there is nothing inside {running}: decompose takes away what is")
        return Goal(expression=old[0], recipe=recipe)
    new = parse(wish.name)
    if wish.verb != "to" and new and old:  # what begins or ends at `none` is refused by the plan, with a word
        _check_verb(wish, running, old, new)
    return Goal(expression=canonical(wish.name), recipe=recipe)


def _check_verb(wish: Wish, running: str, old: tuple[str, ...], new: tuple[str, ...]) -> None:
    if wish.name == running:
        raise ConfigError(f"{running} is what runs already")
    right = verb_for(old, new)
    if right == wish.verb:
        return
    command = "aftbed adapt decompose" if right == "decompose" else f"aftbed adapt {right} {wish.name}"
    if wish.verb == "switch":
        raise ConfigError(f"{new[0]} is the outer mechanism already ({running} runs): {command}")
    if new[0] == old[0]:
        raise ConfigError(f"{wish.name} is not all of {running}, and more inside: {command}")
    if replicates(old[0]) and not any(map(replicates, new)) and not set(new) & set(old):
        instead = f"compose {running}+{wish.name}, or to {wish.name}"
    else:
        instead = f"to {wish.name}" + (f", or switch {new[0]} first" if len(new) > 1 else "")
    raise ConfigError(f"{new[0]} is not what runs ({running}): aftbed adapt {instead}")


def verb_for(old: tuple[str, ...], new: tuple[str, ...]) -> str:
    """The narrowest verb that leads from the mechanisms `old` to `new`."""
    if old[0] != new[0]:
        return "switch"
    if new == old[:1]:
        return "decompose"
    rest = iter(new)
    return "compose" if all(name in rest for name in old) else "to"  # all of `old` in its order


# -- what commands come to ------------------------------------------------------------------------

Resolve = Callable[[Wish], str]  # of an update: where the brick's class, or the function, is found
Judge = Callable[[Graph, Wish], None]


def as_written(wish: Wish) -> str:
    return wish.source


def whatever_suits(graph: Graph, wish: Wish) -> None:
    """Nothing is refused: an experiment may show what comes of a mechanism that does not suit."""


def scheduled(
    texts: tuple[str, ...],
    start: Graph,
    recipe: str,
    *,
    resolve: Resolve = as_written,
    judge: Judge = whatever_suits,
    may_fail: bool = False,
) -> tuple[Scheduled, ...]:
    """The adaptations of a run that begins with `start`, one after the other, as they were given.

    `resolve`: where a brick's source is; `judge` refuses a wish for the graph that it leads to. Raises
    ConfigError, beginning with the text that is wrong.
    """
    found: list[Scheduled] = []
    graph = start
    for text in texts:
        try:
            timed = read(text)
            goal = goal_of(timed.wish, graph, recipe, resolve)
            graph = plan_goal(graph, goal).new
            judge(graph, timed.wish)
        except ConfigError as error:
            raise ConfigError(f"{text!r}: {error}") from error
        goal = msgspec.structs.replace(goal, may_fail=may_fail)
        found.append(Scheduled(goal, timed.at_request, timed.after_ms))
        if len(found) > 1 and before(found[-1], found[-2]):
            raise ConfigError(f"{text!r}: it begins before the one that stands before it")
    return tuple(found)


def goal_of(wish: Wish, graph: Graph, recipe: str, resolve: Resolve) -> Goal:
    """What `wish` comes to where `graph` runs. Raises ConfigError."""
    if wish.verb == "update":
        wish = msgspec.structs.replace(wish, source=resolve(wish))
    return goal(wish, graph.ftm, recipe)


def before(one: Scheduled, other: Scheduled) -> bool:
    """Whether `one` certainly begins before `other`."""
    if one.at_request and other.at_request:
        return one.at_request < other.at_request
    return not one.at_request and not other.at_request and one.after_ms < other.after_ms


def plan_goal(graph: Graph, goal: Goal) -> Plan:
    """The plan that leads from `graph` to `goal`. Raises ConfigError, with all that is wrong in a script."""
    if goal.script is not None:
        found = [str(refusal) for refusal in refusals(graph, goal.script)]
        if found and not goal.file:
            raise ScriptError(f"the script {goal.script.purpose!r} is refused: {'; '.join(found)}")
        refuse(goal.file, found)
        return plan_of(graph, after(graph, goal.script, KINDS), goal.script)
    new = updated(graph, goal.part, goal.source) if goal.part else target(graph, goal.expression)
    return plan(graph, new, goal.recipe)
