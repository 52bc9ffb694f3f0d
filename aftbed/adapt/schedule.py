"""Adaptations that are asked for with a run: words, each for the graph that it will find."""

from collections.abc import Callable

import msgspec

from aftbed.adapt import words
from aftbed.adapt.plan import plan, target, updated
from aftbed.adapt.words import Wish
from aftbed.core.errors import ConfigError
from aftbed.core.graph import Graph
from aftbed.core.messages import Goal, Scheduled

Resolve = Callable[[str], str]
Judge = Callable[[Graph, Wish], None]


def as_written(source: str) -> str:
    """A source is found where its text says."""
    return source


def whatever_suits(graph: Graph, wish: Wish) -> None:
    """An experiment may want to see what comes of a mechanism that does not suit its function."""


def scheduled(
    texts: tuple[str, ...],
    start: Graph,
    recipe: str,
    *,
    resolve: Resolve = as_written,
    judge: Judge = whatever_suits,
) -> tuple[Scheduled, ...]:
    """The adaptations of a run that begins with `start`, one after the other, as they were given.

    `resolve`: where a brick's source is; `judge` refuses a wish for the graph that it leads to. Raises
    ConfigError, beginning with the text that is wrong.
    """
    found: list[Scheduled] = []
    graph = start
    for text in texts:
        try:
            timed = words.read(text)
            goal = goal_of(timed.wish, graph, recipe, resolve)
            graph = led_to(graph, goal)
            judge(graph, timed.wish)
        except ConfigError as error:
            raise ConfigError(f"{text!r}: {error}") from error
        found.append(Scheduled(goal, timed.at_request, timed.after_ms))
        if len(found) > 1 and before(found[-1], found[-2]):
            raise ConfigError(f"{text!r}: it begins before the one that stands before it")
    return tuple(found)


def goal_of(wish: Wish, graph: Graph, recipe: str, resolve: Resolve) -> Goal:
    """What `wish` comes to where `graph` runs. Raises ConfigError."""
    if wish.verb == "update":
        wish = msgspec.structs.replace(wish, source=resolve(wish.source))
    return words.goal(wish, graph.ftm, recipe)


def before(one: Scheduled, other: Scheduled) -> bool:
    """Whether `one` certainly begins before `other`."""
    if one.at_request and other.at_request:
        return one.at_request < other.at_request
    return not one.at_request and not other.at_request and one.after_ms < other.after_ms


def led_to(graph: Graph, goal: Goal) -> Graph:
    """The graph that `goal` leads to. Raises ConfigError if nothing leads there."""
    new = updated(graph, goal.part, goal.source) if goal.part else target(graph, goal.expression)
    plan(graph, new, goal.recipe)
    return new
