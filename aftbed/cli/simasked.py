"""The options of `aftbed sim`, checked: which seeds, and what makes an experiment out of a seed."""

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

import msgspec
from msgspec.structs import replace

from aftbed.adapt import words
from aftbed.cli.adaptation import scheduled
from aftbed.cli.running import RATE_HZ_MAX, SEED_MAX
from aftbed.cli.simview import read_fault
from aftbed.core.errors import ConfigError, unknown
from aftbed.core.graph import Graph
from aftbed.core.messages import Goal, Scheduled
from aftbed.core.script import RECIPES
from aftbed.ftm.compose import build
from aftbed.runtime.sim.givens import check
from aftbed.runtime.sim.world import Setup
from aftbed.search.agreement import SEEDS
from aftbed.search.swarm import drawn
from aftbed.vehicle.scenarios.library import load_scenario

COUNT_MAX: Final = 100_000
LOAD_S_MAX: Final = 3600.0  # of virtual time
MINUTES_MAX: Final = 100_000.0
JOBS_MAX: Final = 256
DEFAULT: Final = Setup()
_RANGE: Final = re.compile(r"([0-9]{1,19})\.\.([0-9]{1,19})")

Make = Callable[[int], Setup]


class Asked(msgspec.Struct, frozen=True):
    """The options of `aftbed sim` as they were typed; None is what was left out."""

    seed: int | None
    seeds: str | None
    ftm: str | None
    placement: str | None
    count: int | None
    rate: float | None
    scenario: str | None
    faults: tuple[str, ...]
    adaptations: tuple[str, ...]
    recipe: str | None
    force: bool
    swarm: bool
    minutes: float | None
    jobs: int | None
    diagram: str | None
    against: tuple[Path, ...] = ()


def seeds_against(asked: Asked) -> int:
    """How many seeds each real experiment is simulated under. Raises ConfigError where more is asked for."""
    others = [name for name in asked.__struct_fields__ if name not in ("seeds", "against")]
    if any(getattr(asked, name) not in (None, (), False) for name in others):
        raise ConfigError("--against: the experiments are the records'; only --seeds and --json go with it")
    first, last = seeds_of(asked) if asked.seeds is not None else (0, SEEDS - 1)
    return last - first + 1


def seeds_of(asked: Asked) -> tuple[int, int]:
    """The first and the last seed. Raises ConfigError."""
    alone = {"--seeds": asked.seeds, "--seed": asked.seed, "--minutes": asked.minutes}
    given = [name for name, value in alone.items() if value is not None]
    if asked.seeds is not None and len(given) > 1:
        raise ConfigError(f"{' and '.join(given)}: --seeds stands alone")
    if asked.minutes is not None and not 0 < asked.minutes <= MINUTES_MAX:
        raise ConfigError(f"--minutes {asked.minutes}: more than 0, up to {MINUTES_MAX:.0f} are allowed")
    if asked.seeds is not None:
        return _range(asked.seeds)
    seed = asked.seed or 0
    if not 0 <= seed <= SEED_MAX:
        raise ConfigError(f"--seed {seed}: 0 to {SEED_MAX} are allowed")
    return seed, SEED_MAX


def _range(text: str) -> tuple[int, int]:
    found = _RANGE.fullmatch(text)
    if found is None:
        raise ConfigError(f"--seeds {text[:60]!r}: A..B is allowed, as 0..99, both ends included")
    first, last = int(found[1]), int(found[2])
    if first > last:
        raise ConfigError(
            f"--seeds {text}: no seed is in it; A..B with A up to B is allowed, as {last}..{first}"
        )
    if last > SEED_MAX:
        raise ConfigError(f"--seeds {text}: 0 to {SEED_MAX} are allowed")
    return first, last


def jobs_of(jobs: int | None) -> int:
    """How many processes simulate. Raises ConfigError."""
    if jobs is not None and not 1 <= jobs <= JOBS_MAX:
        raise ConfigError(f"--jobs {jobs}: 1 to {JOBS_MAX} are allowed")
    return jobs or len(os.sched_getaffinity(0))


def _check_swarm(asked: Asked) -> None:
    drawn_too = {
        "--ftm": asked.ftm,
        "--placement": asked.placement,
        "--count": asked.count,
        "--rate": asked.rate,
        "--scenario": asked.scenario,
        "--faults": asked.faults or None,
        "--adapt": asked.adaptations or None,
        "--recipe": asked.recipe,
        "--force": asked.force or None,
    }
    given = [name for name, value in drawn_too.items() if value is not None]
    if given:
        raise ConfigError(f"--swarm draws everything from the seed: leave out {', '.join(given)}")


def check_diagram(diagram: str | None) -> None:
    """Raises ConfigError if that file cannot be written, before there is anything to write."""
    if diagram is None:
        return
    path = Path(diagram)
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise ConfigError(f"--diagram {diagram}: a file in a directory that exists is allowed")


def made_of(asked: Asked) -> Make:
    """What makes the experiment of a seed. Raises ConfigError."""
    if asked.swarm:
        _check_swarm(asked)
        return drawn
    graph = build(asked.ftm or DEFAULT.ftm, asked.placement or DEFAULT.placement)
    faults = tuple(read_fault(text, graph) for text in asked.faults)
    adaptations = _adaptations(asked, graph)
    setup = replace(
        _load(asked), ftm=graph.ftm, placement=graph.placement, faults=faults, adaptations=adaptations
    )
    for fault in faults:
        check(fault, setup.scenario)
    for late in adaptations:
        if not setup.scenario and late.at_request > setup.count:
            raise ConfigError(
                f"--adapt: at request {late.at_request}: there are {setup.count} requests (--count)"
            )
    return lambda seed: replace(setup, seed=seed)


def _load(asked: Asked) -> Setup:
    """Who makes the requests, how many, how often."""
    if asked.scenario is not None:
        if asked.count is not None or asked.rate is not None:
            raise ConfigError("--scenario: the car makes the requests; leave out --count and --rate")
        load_scenario(asked.scenario)
        return Setup(scenario=asked.scenario)
    count = DEFAULT.count if asked.count is None else asked.count
    rate_hz = DEFAULT.rate_hz if asked.rate is None else asked.rate
    if not 1 <= count <= COUNT_MAX:
        raise ConfigError(f"--count {count}: 1 to {COUNT_MAX} requests are allowed")
    if asked.rate is not None and not 0 < rate_hz <= RATE_HZ_MAX:
        raise ConfigError(
            f"--rate {rate_hz}: more than 0, up to {RATE_HZ_MAX:.0f} a second are allowed"
            " (without it, each follows the reply before)"
        )
    if rate_hz and count / rate_hz > LOAD_S_MAX:
        raise ConfigError(f"--count {count} --rate {rate_hz}: {LOAD_S_MAX:.0f} s of virtual time are allowed")
    return Setup(count=count, rate_hz=rate_hz)


def _adaptations(asked: Asked, graph: Graph) -> tuple[Scheduled, ...]:
    recipe = asked.recipe or RECIPES[0]
    if recipe not in RECIPES:
        raise unknown("recipe", recipe, RECIPES)
    if not asked.adaptations and (asked.recipe is not None or asked.force):
        raise ConfigError("--recipe and --force say how --adapt is carried out: give --adapt too")
    if not asked.force:
        found = scheduled(asked.adaptations, graph, recipe, force=False)
    else:
        found = tuple(_forced(text, recipe) for text in asked.adaptations)
    for text, adaptation in zip(asked.adaptations, found, strict=True):
        if adaptation.goal.source:
            raise ConfigError(f"--adapt {text!r}: the simulator loads no brick that was written off line")
    return found


def _forced(text: str, recipe: str) -> Scheduled:
    """As it stands: whether it can be carried out, the Engine says when it begins."""
    timed = words.read(text)
    if timed.wish.verb == "decompose":
        raise ConfigError(f"--adapt {text!r}: with --force, the whole of what will run is named: to EXPR")
    build(timed.wish.name, DEFAULT.placement)
    return Scheduled(Goal(expression=timed.wish.name, recipe=recipe), timed.at_request, timed.after_ms)
