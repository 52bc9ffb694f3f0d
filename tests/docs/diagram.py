"""State diagrams, made from the tables that the bricks execute (docs/machines.md).

All moves from a state to another share one arrow, a line each: Mermaid would draw those of a state to itself
over each other.
"""

from collections.abc import Iterator

from aftbed.core.brick import CONTROL, Machine, Table
from aftbed.core.messages import Rebound


def mermaid(kind: type[Machine]) -> str:
    """One diagram for each table of `kind`."""
    return "\n\n".join(
        "\n".join(
            [
                *([f"Table *{name}*:", ""] if name else []),
                "```mermaid",
                "stateDiagram-v2",
                *_arrows(table),
                "```",
            ]
        )
        for name, table in kind.TABLES.items()
    )


def _arrows(table: Table) -> Iterator[str]:
    """One for each pair of states, in the order of their first moves."""
    arrows: dict[tuple[str, str], list[str]] = {}
    for state, then, words in _moves(table):
        arrows.setdefault((state, then), []).append(words)
    for (state, then), lines in arrows.items():
        yield f"    {state} --> {then}: {'<br/>'.join(lines)}"


def _moves(table: Table) -> Iterator[tuple[str, str, str]]:
    """From where, whereto, and the words of each move.

    A Rebound that changes no state is left out: every brick receives it.
    """
    moves = [
        (state, port, kind, f" [{do.__name__} = {getattr(answer, 'name', answer)}]", *move)
        for (state, port, kind), (do, _, answers) in table.rows.items()
        for answer, move in (answers or {}).items()
    ]
    moves += [
        (state, port, kind, "", do, then)
        for (state, port, kind), (do, then, answers) in table.rows.items()
        if answers is None and then is not None
    ]
    order = list(table.rows)
    entered = {then for state, *_, then in moves if then is not state}
    reached = [state for state in table.states if state in entered or table.open_ports[state]]
    for state, port, kind, answer, do, then in sorted(moves, key=lambda move: order.index(move[:3])):
        if state in reached and (kind is not Rebound or then is not state):
            message = kind.__name__ if port == CONTROL else f"{port} {kind.__name__}"
            name = do.__qualname__.rpartition(".")[2]
            yield state.name, then.name, f"{message}{answer} / {name}"
