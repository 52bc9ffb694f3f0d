"""What becomes of an `Assign`: the bricks of a node, made, tried where they are strangers, and joined."""

from collections.abc import Callable
from typing import Protocol

from aftbed.adapt import selftest
from aftbed.adapt.bricks import LoadModule, load_application, make_brick
from aftbed.core.application import Application
from aftbed.core.brick import Brick
from aftbed.core.graph import BrickSpec
from aftbed.ftm.compose import REPLICAS
from aftbed.ftm.registry import Setting
from aftbed.runtime import control

Make = Callable[[BrickSpec, Setting], Brick]


class Assembled(Protocol):
    """A node in the making."""

    def add(self, name: str, brick: Brick) -> None:
        """Host `brick`."""
        ...

    def link_inside(self, local: control.Local, epoch: int) -> None:
        """A channel between two bricks of this node; the source is told."""
        ...


class Assembler:
    """`function`: what is protected if the graph names nothing else; `load`: how a class is found."""

    def __init__(
        self, function: Callable[[], Application], load: LoadModule, make: Make | None = None
    ) -> None:
        self._function, self._load = function, load
        self._make: Make = make or (lambda spec, setting: make_brick(spec, setting, load))

    def fill(self, node: Assembled, order: control.Assign) -> None:
        """Make the bricks of `order`. Raises ConfigError where one that was written off line is no good."""
        for spec in order.bricks:
            node.add(spec.name, self._make(spec, self._setting(spec, order)))
        if order.trial is not None:
            self._try_out(order, order.trial)
        for local in order.locals:
            node.link_inside(local, order.epoch)

    def _setting(self, spec: BrickSpec, order: control.Assign, leader: str = "") -> Setting:
        """What a brick is made for: whose it is, whether it leads, and the function if that is not ours."""
        number = REPLICAS.index(spec.replica) + 1 if spec.replica else 0
        named = load_application(spec.application, self._load) if spec.application else self._function
        epoch = selftest.EPOCH if leader else order.epoch
        return Setting(number, epoch, spec.replica == (leader or order.leader), named)

    def _try_out(self, order: control.Assign, trial: control.Trial) -> None:
        """The self-test of what was written off line."""
        replica = next(s.replica for s in order.bricks if s.replica)
        server = next(b for b in trial.graph.bricks if b.part == "server")

        def setting(spec: BrickSpec) -> Setting:
            return self._setting(spec, order, leader=replica)

        selftest.run(
            trial.graph,
            replica,
            lambda spec: self._make(spec, setting(spec)),
            trial.requests,
            deterministic=setting(server).application().characteristics.deterministic,
        )
