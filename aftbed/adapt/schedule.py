"""Adaptations that are asked for with a run: words, each for the graph that it will find."""

from aftbed.adapt import words
from aftbed.adapt.plan import plan, target, updated
from aftbed.core.errors import ConfigError
from aftbed.core.graph import Graph
from aftbed.core.message import Goal, Scheduled


def scheduled(texts: tuple[str, ...], start: Graph, recipe: str) -> tuple[Scheduled, ...]:
    """The adaptations of a run that begins with `start`, one after the other. Raises ConfigError.

    Whether a mechanism suits its function is not asked: an experiment may want to see what comes of it.
    """
    found: list[Scheduled] = []
    graph = start
    for text in texts:
        try:
            timed = words.read(text)
            goal = words.goal(timed.wish, graph.ftm, recipe)
            graph = led_to(graph, goal)
        except ConfigError as error:
            raise ConfigError(f"{text!r}: {error}") from error
        found.append(Scheduled(goal, timed.at_request, timed.after_ms))
        if len(found) > 1 and before(found[-1], found[-2]):
            raise ConfigError(f"{text!r}: it begins before the one that stands before it")
    return tuple(found)


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
