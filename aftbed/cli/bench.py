import typer

bench = typer.Typer(help="Measure, beside the bare limit.", no_args_is_help=True, rich_markup_mode=None)


@bench.command()
def cycle() -> None:
    """x"""


@bench.command()
def recovery() -> None:
    """x"""
