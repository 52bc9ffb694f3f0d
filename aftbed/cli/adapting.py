"""`aftbed adapt`: another mechanism, another brick, another function, while the run goes on."""

from typing import Annotated

import typer

adapt = typer.Typer(
    help="Change the mechanism of a live run: update, switch, compose.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

Expr = Annotated[str, typer.Argument(help="All that will run, the outer mechanism first: lfr+tr.")]
Recipe = Annotated[str, typer.Option(help="drained, or paper: SIGSTOP, kill, launch, link, SIGCONT.")]
Force = Annotated[bool, typer.Option("--force", help="Even where it does not suit the function.")]
Run = Annotated[str | None, typer.Option("--run", help="Id of the run, where several are alive.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]


@adapt.command()
def to(
    expr: Expr, recipe: Recipe = "drained", force: Force = False, run: Run = None, json: Json = False
) -> None:
    """Whatever runs, have EXPR run instead.

    Exit code of all that adapts: 0 done, 1 rolled back, 2 refused.
    """
    _change("to", expr, recipe, run, force=force, json=json)


@adapt.command()
def switch(
    expr: Expr, recipe: Recipe = "drained", force: Force = False, run: Run = None, json: Json = False
) -> None:
    """The outer mechanism becomes another one."""
    _change("switch", expr, recipe, run, force=force, json=json)


@adapt.command()
def compose(
    expr: Expr, recipe: Recipe = "drained", force: Force = False, run: Run = None, json: Json = False
) -> None:
    """The outer mechanism stays, and gets more inside."""
    _change("compose", expr, recipe, run, force=force, json=json)


@adapt.command()
def decompose(recipe: Recipe = "drained", run: Run = None, json: Json = False) -> None:
    """The outer mechanism stays, what is inside goes."""
    _change("decompose", "", recipe, run, force=False, json=json)


@adapt.command()
def update(
    brick: Annotated[str, typer.Argument(help="A brick of a replica, as tr.after; app is the function.")],
    source: Annotated[str, typer.Option("--to", help="MODULE:CLASS or FILE.py:CLASS.")],
    recipe: Recipe = "drained",
    force: Force = False,
    run: Run = None,
    json: Json = False,
) -> None:
    """Another class for one brick, on every replica; it may have been written after the run began."""
    _change("update", brick, recipe, run, force=force, json=json, source=source)


@adapt.command()
def plan(
    expr: Expr,
    start: Annotated[
        str | None, typer.Option("--from", help="From this mechanism; without it, from what runs.")
    ] = None,
    placement: Annotated[
        str | None, typer.Option(help="With --from: process (default), replica or single.")
    ] = None,
    recipe: Recipe = "drained",
    run: Run = None,
    yaml: Annotated[bool, typer.Option("--yaml", help="Print the script as a file.")] = False,
    json: Json = False,
) -> None:
    """What an adaptation to EXPR would do, step by step, and the way back. Nothing is changed."""
    from aftbed.cli import adaptation  # noqa: PLC0415

    adaptation.show_plan(run, expr, start, placement, recipe, as_yaml=yaml, as_json=json)


@adapt.command()
def script(
    file: Annotated[str, typer.Argument(help="A YAML file, as `adapt plan --yaml` prints it.")],
    run: Run = None,
    json: Json = False,
) -> None:
    """Carry out a script that was written by hand; it is checked whole before its first step."""
    from aftbed.cli import adaptation  # noqa: PLC0415

    raise typer.Exit(adaptation.carry_out(run, file, as_json=json))


@adapt.command()
def history(run: Run = None, json: Json = False) -> None:
    """The adaptations of the run that have ended, and how."""
    from aftbed.cli import adaptation  # noqa: PLC0415

    adaptation.show_history(run, as_json=json)


def _change(
    verb: str, name: str, recipe: str, run: str | None, *, force: bool, json: bool, source: str = ""
) -> None:
    from aftbed.adapt.words import Wish  # noqa: PLC0415
    from aftbed.cli import adaptation  # noqa: PLC0415

    wish = Wish(verb, name, source)
    raise typer.Exit(adaptation.change(run, wish, recipe, force=force, as_json=json))
