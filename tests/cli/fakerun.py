"""A fake live run that answers the commands of a second terminal; real ones are in `tests/process`."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec

from aftbed.adapt.commands import plan_goal
from aftbed.adapt.planner import plan
from aftbed.core.errors import ConfigError
from aftbed.core.graph import Graph
from aftbed.core.messages import Goal
from aftbed.ftm.compose import build
from aftbed.inject.model import Fault
from aftbed.runtime.unix import control_client

Call = Callable[..., tuple[int, str, str]]  # `aftbed` with these arguments: exit code, output, errors
Output = Callable[..., str]
VARIANTS: Final = "aftbed.vehicle.aeb.variants"
CLOSED: Final = f"{VARIANTS}:WithoutStateAccess"
RANDOM: Final = f"{VARIANTS}:NonDeterministic"
CAUTIOUS: Final = f"{VARIANTS}:Cautious"
OUTCOME: Final = {
    "number": 3,
    "purpose": "pbr to lfr",
    "recipe": "drained",
    "ftm": "lfr",
    "outcome": "done",
    "reason": "",
    "asked_ms": 1234.5,
    "prepare_ms": 12.25,
    "blackout_ms": 0.75,
    "total_ms": 118.5,
    "bricks_changed": 4,
    "bricks_total": 16,
}


class FakeRun:
    """A run that answers questions, and keeps the goals and faults that it was asked for."""

    def __init__(self) -> None:
        self.graph: Graph = build("pbr", "process")
        self.outcome: dict[str, object] = dict(OUTCOME)
        self.history: list[dict[str, object]] = []
        self.goals: list[Goal] = []
        self.faults: list[Fault] = []
        self.seconds = 0.0
        self.record = Path("/nowhere/record")

    def ask(
        self, private: Path, question: control_client.ControlRequest, seconds: float = 0.0
    ) -> dict[str, object]:
        """Replaces `ask.ask`."""
        assert private.name == "abc123"
        match question:
            case control_client.GraphQuery():
                return msgspec.json.decode(msgspec.json.encode(self.graph))  # type: ignore[no-any-return]
            case control_client.StatusQuery():
                return {"record": str(self.record)}
            case control_client.InjectCommand(fault):
                self.faults.append(fault)
                return {}
            case control_client.StopCommand():
                return {"stopping": True}
            case control_client.AdaptationsQuery():
                return {"adaptations": self.history}
            case control_client.PlanQuery(goal):
                there = plan_goal(self.graph, goal)
                found = control_client.PlanAnswer(there, plan(there.new, there.old, goal.recipe))
                return msgspec.json.decode(msgspec.json.encode(found))  # type: ignore[no-any-return]
            case control_client.AdaptCommand(goal):
                plan_goal(self.graph, goal)
                self.goals.append(goal)
                self.seconds = seconds
                if self.outcome["outcome"] == "refused" and self.outcome["reason"]:
                    raise ConfigError(str(self.outcome["reason"]))
                return self.outcome
            case _:
                raise AssertionError(question)
