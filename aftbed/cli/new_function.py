"""`aftbed app new NAME`: a project with a function of the user, which passes its own tests."""

import contextlib
import re
import shutil
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import typer

from aftbed import functions
from aftbed.cli.options import Json, print_json
from aftbed.core.errors import ConfigError, unknown

NAME: Final = re.compile(r"[a-z][a-z0-9-]{0,39}")
TEMPLATES: Final = Path(functions.__file__).parent / "templates"
SUFFIX: Final = ".tmpl"  # so none is a module of this package; other files are copied
EVERY_KIND: Final = {  # file of a project: its template
    "README.md": "all/README.md.tmpl",
    "requests.csv": "all/requests.csv.tmpl",
    "test_function.py": "all/test_function.py.tmpl",
    "campaign.yaml": "all/campaign.yaml.tmpl",
    ".github/workflows/test.yml": "all/workflow.yml.tmpl",
}


class ProjectKind(NamedTuple):
    """`app`: what `--app` takes in the project. `first`: the command that makes it, and `needs` what pip has
    to install for it; "" for none.
    """

    app: str
    source: str
    files: dict[str, str]
    first: str = ""
    needs: str = ""


KINDS: Final = {
    "class": ProjectKind("function.py:Function", "function.py", {"function.py": "class/function.py.tmpl"}),
    "so": ProjectKind(
        "function.so",
        "function.c",
        {"function.c": "so/function.c.tmpl", "Makefile": "so/Makefile.tmpl", "aft.h": "../aft.h"},
        first="make",
    ),
    "fmu": ProjectKind(
        "function.fmu",
        "function.c",
        {
            name: f"fmu/{name}.tmpl"
            for name in ("function.c", "modelDescription.xml", "ports.yaml", "Makefile")
        },
        first="make",
        needs="FMPy",
    ),
    "stdio": ProjectKind("python3 function.py", "function.py", {"function.py": "stdio/function.py.tmpl"}),
}


def new(
    name: Annotated[str, typer.Argument(help="Of the project, and of its new directory.")],
    kind: Annotated[str, typer.Option(help=f"What the function is: {', '.join(KINDS)}.")] = "class",
    json: Json = False,
) -> None:
    """Write a project with a function, its requests, tests, a campaign and a CI workflow."""
    folder = create(name, kind)
    first = f"{KINDS[kind].first} && " if KINDS[kind].first else ""
    files, following = sorted(_files(kind)), f"cd {folder} && {first}pytest"
    if json:
        print_json({"directory": str(folder), "files": files, "next": following})
    else:
        typer.echo(f"{folder}/: {', '.join(files)}")
        typer.echo(f"next: {following}")


def create(name: str, kind: str) -> Path:
    """The new directory. Raises ConfigError, leaving nothing."""
    if kind not in KINDS:
        raise unknown("kind", kind, KINDS)
    if not NAME.fullmatch(name):
        raise ConfigError(
            f"{name[:60]!r} is no name of a project: a small letter, then up to 39 small letters, digits"
            " and '-' are allowed"
        )
    content = {file: _filled(template, name, KINDS[kind]) for file, template in _files(kind).items()}
    folder = Path(name)
    try:
        folder.mkdir()
    except FileExistsError:
        raise ConfigError(f"{name}: is there already; a new directory is allowed") from None
    except OSError as error:
        raise ConfigError(f"{name}: cannot be made: {error.strerror}") from None
    with contextlib.ExitStack() as undo:
        undo.callback(shutil.rmtree, folder, ignore_errors=True)
        try:
            for file, text in content.items():
                path = folder / file
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text)
        except OSError as error:
            raise ConfigError(f"{name}: cannot be written: {error.strerror}") from None
        undo.pop_all()
    return folder


def _files(kind: str) -> dict[str, str]:
    return EVERY_KIND | KINDS[kind].files


def _filled(template: str, name: str, kind: ProjectKind) -> str:
    text = (TEMPLATES / template).read_text()
    words = {
        "NAME": name,
        "APP": kind.app,
        "SOURCE": kind.source,
        "FIRST": f"{kind.first} && " if kind.first else "",
        "NEEDS": f" {kind.needs}" if kind.needs else "",
    }
    return re.sub(r"@([A-Z]+)@", lambda found: words[found[1]], text) if template.endswith(SUFFIX) else text
