"""`aftbed explore`: not some experiments of a kind, but all there are, with a count that is exact."""

from typing import Annotated, Final

import typer

explore = typer.Typer(
    help="Simulate all there is of one kind: exhaustive, with an exact count.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
REQUESTS: Final = 3
ORDER_REQUESTS: Final = 2
BOUND: Final = 2_000

Ftm = Annotated[
    list[str] | None,
    typer.Option(help="Mechanisms, separated by commas or given one by one; else all it knows."),
]
Placement = Annotated[list[str] | None, typer.Option(help="process or replica, likewise; both if left out.")]
Jobs = Annotated[int | None, typer.Option(help="Processes; one per CPU if left out.")]
Only = Annotated[int | None, typer.Option(help="One experiment of this selection, by its number.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]


@explore.command()
def crash(
    ftm: Ftm = None,
    placement: Placement = None,
    requests: Annotated[int, typer.Option(help="Of each run.")] = REQUESTS,
    jobs: Jobs = None,
    only: Only = None,
    json: Json = False,
) -> None:
    """A death before each effect of each brick, and after its last.

    Exit code of all explorers: 0 all survived, 1 a promise was broken, 2 usage, 130 interrupted.
    """
    _explore("crash", ftm, placement, jobs, only, json=json, requests=requests)


@explore.command()
def adapt(
    ftm: Ftm = None, placement: Placement = None, jobs: Jobs = None, only: Only = None, json: Json = False
) -> None:
    """A death before, during and after each step of each adaptation, of each node that takes part."""
    _explore("adapt", ftm, placement, jobs, only, json=json)


@explore.command()
def pairs(
    ftm: Ftm = None, placement: Placement = None, jobs: Jobs = None, only: Only = None, json: Json = False
) -> None:
    """Each first fault of a few, then the death of each node, after each delay of a grid."""
    _explore("pairs", ftm, placement, jobs, only, json=json)


@explore.command()
def order(
    ftm: Ftm = None,
    placement: Placement = None,
    requests: Annotated[int, typer.Option(help="At most, undisturbed; one with a crash.")] = ORDER_REQUESTS,
    bound: Annotated[int, typer.Option(help="Runs of one experiment, at most.")] = BOUND,
    jobs: Jobs = None,
    json: Json = False,
) -> None:
    """Every order in which messages can arrive, but for those that make no difference."""
    from aftbed.cli import exploring, ordering  # noqa: PLC0415

    asked = exploring.Asked("order", _names(ftm), _names(placement), requests, jobs, None)
    raise typer.Exit(ordering.run(asked, bound, as_json=json))


def _explore(
    explorer: str,
    ftm: list[str] | None,
    placement: list[str] | None,
    jobs: int | None,
    only: int | None,
    *,
    json: bool,
    requests: int | None = None,
) -> None:
    from aftbed.cli import exploring  # noqa: PLC0415

    asked = exploring.Asked(
        explorer=explorer,
        ftms=_names(ftm),
        placements=_names(placement),
        requests=requests,
        jobs=jobs,
        only=only,
    )
    raise typer.Exit(exploring.run(asked, as_json=json))


def _names(given: list[str] | None) -> tuple[str, ...]:
    """Separated by commas, or given one by one."""
    return tuple(name for text in given or () for name in text.split(","))
