"""docs/machines.md is made from the tables that the bricks execute; `--rewrite` makes it anew."""

from typing import Final

from diagram import mermaid
from pages import ROOT

from aftbed.adapt.engine import AdaptationEngine
from aftbed.core.application import Application
from aftbed.core.brick import Machine
from aftbed.ftm.registry import BRICKS, Setting
from aftbed.vehicle.aeb.function import default_application

PAGE: Final = ROOT / "docs" / "machines.md"
HEAD: Final = """# The state machines of the bricks

Made from the tables that the bricks execute ([how to read one](bricks.md#how-to-read-one)); do not edit.
A line at an arrow is a row: `port message [question = answer] / handler`. A message from the runtime has no
port. A message without a line is refused. A Rebound that changes no state is left out: every brick gets it.
The Watchdogs and Recovery have no states.
"""


def machines() -> dict[str, type[Machine]]:
    """The class of each kind of brick that has a table, by its name."""

    def application() -> Application:
        return default_application()

    made = (type(kind.make(Setting(1, 1, True, application))) for kind in BRICKS.values())
    found = [kind for kind in made if issubclass(kind, Machine)]
    return {kind.__name__: kind for kind in (*found, AdaptationEngine)}


def page() -> str:
    parts = (f"## {name}\n\n{mermaid(kind)}\n" for name, kind in machines().items())
    return "\n".join([HEAD, *parts])


def test_the_page_shows_the_tables(rewrite: bool) -> None:
    if rewrite:
        PAGE.write_text(page())
    assert PAGE.read_text() == page(), "pytest tests/docs/test_machines.py --rewrite"


def test_a_diagram_shows_each_row_and_each_answer() -> None:
    for kind in machines().values():
        text = mermaid(kind)
        for table in kind.TABLES.values():
            assert all(state.name in text for state, ports in table.open_ports.items() if ports)


def test_moves_between_the_same_states_share_an_arrow() -> None:
    text = mermaid(machines()["Protocol"])
    assert "IDLE --> IDLE: pxy2pro Request [age = OLD] / answer_again" in text
    for kind in machines().values():
        for diagram in mermaid(kind).split("```mermaid")[1:]:
            arrows = [line.partition(":")[0] for line in diagram.splitlines() if "-->" in line]
            assert len(set(arrows)) == len(arrows)
