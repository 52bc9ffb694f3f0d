"""`aftbed init KIND [NAME]`: a file or a project to begin with. It works as it is and says what to try next.

Nothing is overwritten. Beside a YAML file its schema is put into `.aftbed/`, and the first line of the file
names it: an editor with a YAML language server then completes its keys. The schema is rewritten by each
`init`; the path to it is relative, so both can be moved or committed together.
"""

import contextlib
import re
import shlex
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import typer

from aftbed import functions
from aftbed.cli.options import Json, choices, print_json
from aftbed.cli.parsing import PlainGroup
from aftbed.cli.schema import schema_text
from aftbed.core.errors import ConfigError, unknown
from aftbed.ftm import registry
from aftbed.interop.files import write_text_whole

FILE_TEMPLATES: Final = Path(__file__).with_name("templates")
_SCHEMA: Final = re.compile(
    r"# yaml-language-server: \$schema=(?P<place>\.aftbed/(?P<kind>\w+)\.schema\.json)\n"
)
FILE_NAME: Final = re.compile(r"[a-z0-9][a-z0-9-]{0,40}")  # of a campaign, too

init = typer.Typer(cls=PlainGroup)

To = Annotated[Path | None, typer.Option("--to", help="Where to write it; NAME.yaml here if left out.")]
ToFolder = Annotated[Path | None, typer.Option("--to", help="The new directory.")]


# -- one file -------------------------------------------------------------------------------------


class FileKind(NamedTuple):
    """`about`: what it is. `others`: files that it needs beside it, by their ending. `next`: what to run."""

    about: str
    next: str
    others: tuple[str, ...] = ()


FILES: Final = {
    "scenario": FileKind("a drive", "aftbed run --scenario @FILE@ --pace max"),
    "campaign": FileKind("many experiments and their gates", "aftbed campaign run @FILE@ --out @NAME@"),
    "map": FileKind(
        "how a radar reports, with a log of one",
        "aftbed run --replay @LOG@ --dbc ars408-like --map @FILE@ --pace max",
        (".log",),
    ),
    "policy": FileKind(
        "when which mechanism is adapted",
        'aftbed run --ftm lfr --load 800@400 --policy @FILE@ --inject "bitflip result in b nth 100"'
        ' --inject "bitflip result in b nth 160"',
    ),
    "script": FileKind(
        "an adaptation, step by step",
        "aftbed run --ftm pbr --load 3000@100; then in a second terminal: aftbed adapt script @FILE@",
    ),
}


def _file_command(kind: str) -> None:
    about, default = FILES[kind].about, f"my-{kind}"

    @init.command(kind, help=f"Write a {kind} file: {about}.")
    def command(
        name: Annotated[str, typer.Argument(help="Of the file, without its ending.")] = default,
        to: To = None,
        json: Json = False,
    ) -> None:
        path, words = write_file(kind, name, to)
        files = [path, *(path.with_suffix(ending) for ending in FILES[kind].others)]
        _tell(map(str, files), _filled(FILES[kind].next, words), as_json=json)


for _kind in FILES:
    _file_command(_kind)


def write_file(kind: str, name: str, to: Path | None) -> tuple[Path, dict[str, str]]:
    """The new file, and the words of its template. Raises ConfigError, leaving nothing new of it."""
    if to is not None:
        name = to.stem
    if not FILE_NAME.fullmatch(name):
        raise ConfigError(
            f"{name[:60]!r} is no name of a file: small letters, digits and '-' are allowed, 41 at most"
        )
    path = to or Path(f"{name}.yaml")
    if path.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"--to {path}: a file .yaml or .yml is allowed")
    words = {
        "NAME": name,
        "FILE": shlex.quote(str(path)),
        "LOG": shlex.quote(str(path.with_suffix(".log"))),
    }
    endings = (".yaml", *FILES[kind].others)
    content = {
        path if ending == ".yaml" else path.with_suffix(ending): _filled(
            (FILE_TEMPLATES / f"{kind}{ending}{SUFFIX}").read_text(), words
        )
        for ending in endings
    }
    with contextlib.ExitStack() as undo:
        for file, text in content.items():
            _write_new(file, text, undo)
        for place, text in _schemas(content.values()).items():
            _write_schema(path.parent / place, text)
        undo.pop_all()
    return path, words


def _write_new(file: Path, text: str, undo: contextlib.ExitStack) -> None:
    try:
        with file.open("x") as sink:
            undo.callback(file.unlink, missing_ok=True)
            sink.write(text)
    except FileExistsError:
        raise ConfigError(f"{file}: is there already; choose another name, or --to FILE") from None
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written: {error.strerror}") from None


def _write_schema(file: Path, text: str) -> None:
    try:
        file.parent.mkdir(exist_ok=True)
        write_text_whole(file, text)
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written: {error.strerror}") from None


# -- the package of a mechanism -------------------------------------------------------------------

MECHANISM_FILES: Final = {
    "README.md": "README.md",
    "pyproject.toml": "pyproject.toml",
    "aftbed_@NAME@/__init__.py": "mechanism.py",
    "test_@NAME@.py": "test_mechanism.py",
}


@init.command()
def mechanism(
    name: Annotated[str, typer.Argument(help="Of the mechanism, as --ftm takes it.")] = "limit",
    to: ToFolder = None,
    json: Json = False,
) -> None:
    """Write a package with a mechanism, tests, and the entry point by which it is found."""
    folder = write_mechanism(name, to)
    files = (file.replace("@NAME@", name) for file in MECHANISM_FILES)
    _tell(_below(folder, files), f"cd {shlex.quote(str(folder))} && pip install -e . && pytest", as_json=json)


def write_mechanism(name: str, to: Path | None) -> Path:
    """The new directory. Raises ConfigError, leaving nothing."""
    if not registry.NAME.fullmatch(name) or name in registry.RESERVED:
        raise ConfigError(
            f"{name[:60]!r} is no name of a mechanism: a small letter, then up to 19 small letters and"
            " digits are allowed"
        )
    if name in registry.names():
        raise ConfigError(f"there is a mechanism {name} already; choose another name: aftbed ftm list")
    content = {
        file.replace("@NAME@", name): _filled(
            (FILE_TEMPLATES / "mechanism" / f"{template}{SUFFIX}").read_text(), {"NAME": name}
        )
        for file, template in MECHANISM_FILES.items()
    }
    return write_folder(to or Path(f"aftbed-{name}"), content)


# -- the project of a function --------------------------------------------------------------------

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


@init.command("function")
def new(
    name: Annotated[str, typer.Argument(help="Of the project, and of its new directory.")],
    kind: Annotated[str, typer.Option(metavar=choices(KINDS), help="What the function is.")] = "class",
    to: ToFolder = None,
    json: Json = False,
) -> None:
    """Write a project with a function, its requests, tests, a campaign and a CI workflow."""
    folder = create(name, kind, to)
    first = f"{KINDS[kind].first} && " if KINDS[kind].first else ""
    _tell(_below(folder, _files(kind)), f"cd {shlex.quote(str(folder))} && {first}pytest", as_json=json)


def create(name: str, kind: str, to: Path | None = None) -> Path:
    """The new directory. Raises ConfigError, leaving nothing."""
    if kind not in KINDS:
        raise unknown("kind", kind, KINDS)
    if not NAME.fullmatch(name):
        raise ConfigError(
            f"{name[:60]!r} is no name of a project: a small letter, then up to 39 small letters, digits"
            " and '-' are allowed"
        )
    words = {
        "NAME": name,
        "APP": KINDS[kind].app,
        "SOURCE": KINDS[kind].source,
        "FIRST": f"{KINDS[kind].first} && " if KINDS[kind].first else "",
        "NEEDS": f" {KINDS[kind].needs}" if KINDS[kind].needs else "",
    }
    content = {}
    for file, template in _files(kind).items():
        text = (TEMPLATES / template).read_text()
        content[file] = _filled(text, words) if template.endswith(SUFFIX) else text
    return write_folder(to or Path(name), content | _schemas(content.values()))


def _files(kind: str) -> dict[str, str]:
    return EVERY_KIND | KINDS[kind].files


# -- writing --------------------------------------------------------------------------------------


def _below(folder: Path, files: Iterable[str]) -> list[str]:
    return [str(folder / file) for file in sorted(files)]


def _tell(files: Iterable[str], following: str, *, as_json: bool) -> None:
    """What was written, and the command to try next."""
    if as_json:
        print_json({"files": list(files), "next": following})
        return
    for file in files:
        print(f"{file}: written")
    print(f"next: {following}")


def write_folder(folder: Path, content: Mapping[str, str]) -> Path:
    """A new directory with these files. Raises ConfigError, leaving nothing."""
    try:
        folder.mkdir()
    except FileExistsError:
        raise ConfigError(f"{folder}: is there already; a new directory is allowed") from None
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made: {error.strerror}") from None
    with contextlib.ExitStack() as undo:
        undo.callback(shutil.rmtree, folder, ignore_errors=True)
        try:
            for file, text in content.items():
                path = folder / file
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text)
        except OSError as error:
            raise ConfigError(f"{folder}: cannot be written: {error.strerror}") from None
        undo.pop_all()
    return folder


def _schemas(texts: Iterable[str]) -> dict[str, str]:
    """By its place, each schema that the first line of a text names."""
    named = [found for text in texts if (found := _SCHEMA.match(text))]
    return {found["place"]: f"{schema_text(found['kind'])}\n" for found in named}


def _filled(template: str, words: Mapping[str, str]) -> str:
    return re.sub(r"@([A-Z]+)@", lambda found: words[found[1]], template)
