"""`aftbed bench paper`: measures, shows, writes the page."""

import sys
from pathlib import Path
from typing import Annotated, Final

import typer

PROGRESS: Final = "  measuring: "


def paper(
    quick: Annotated[
        bool, typer.Option("--quick", help="A look in half a minute: too few samples to quote.")
    ] = False,
    html: Annotated[Path | None, typer.Option(help="Write a page with plots to this file.")] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print the tables as markdown.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Every figure of the paper's Section IV beside ours, measured now; placements; sweeps."""
    from aftbed.bench.paper import FULL, QUICK, bench_paper  # noqa: PLC0415
    from aftbed.core.errors import ConfigError  # noqa: PLC0415

    if json and markdown:
        raise ConfigError("--json and --markdown: one of them is allowed")
    if html is not None and not html.parent.is_dir():
        raise ConfigError(f"--html {html}: {html.parent} is no directory")
    if html is not None and html.is_dir():
        raise ConfigError(f"--html {html}: a directory; the name of a file is allowed")
    found = bench_paper(QUICK if quick else FULL, _tell)
    if json:
        import msgspec  # noqa: PLC0415

        print(msgspec.json.encode(found).decode())
    else:
        from aftbed.bench import papertext  # noqa: PLC0415

        for line in papertext.markdown(found) if markdown else papertext.text(found):
            print(line)
    if html is not None:
        from aftbed.bench.paperpage import html_page  # noqa: PLC0415

        html.write_text(html_page(found), encoding="utf-8")


def _tell(what: str) -> None:
    print(f"{PROGRESS}{what}", file=sys.stderr, flush=True)
