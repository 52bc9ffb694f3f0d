"""Options that are converted without pydantic: the same values as those of typer, and as much is refused."""

import string
from pathlib import Path
from typing import Annotated

import pytest
import typer
from hypothesis import example, given
from hypothesis import strategies as st
from typer.core import TyperCommand
from typer.testing import CliRunner

from aftbed.cli.parsing import PlainCommand
from aftbed.core.errors import ConfigError

Found = dict[str, object]


def program(kind: type[TyperCommand], found: list[Found]) -> typer.Typer:
    """A program of one command, which notes the values that it gets."""
    app = typer.Typer(rich_markup_mode=None, add_completion=False)

    @app.command(cls=kind)
    def drive(
        place: Annotated[Path, typer.Argument()],
        then: Annotated[str | None, typer.Argument()] = None,
        word: Annotated[str, typer.Option()] = "pbr",
        whole: Annotated[int, typer.Option()] = 0,
        least: Annotated[int, typer.Option(min=10)] = 12,
        maybe: Annotated[int | None, typer.Option()] = None,
        real: Annotated[float | None, typer.Option()] = None,
        pin: Annotated[bool, typer.Option()] = True,
        json: Annotated[bool, typer.Option("--json")] = False,
        faults: Annotated[list[str] | None, typer.Option("--inject")] = None,
        several: Annotated[list[int], typer.Option("--nth")] = [1, 2],  # noqa: B006 - typer copies it
        folders: Annotated[list[Path] | None, typer.Option("--trust")] = None,
        out: Annotated[Path | None, typer.Option()] = None,
        known: Annotated[Path | None, typer.Option(exists=True)] = None,
    ) -> None:
        found.append({name: value for name, value in locals().items() if name != "found"})

    return app


def outcome(kind: type[TyperCommand], words: list[str]) -> tuple[bool, str, list[dict[str, str]]]:
    """Whether it was refused, what was printed if not, and the values if the command was called."""
    found: list[Found] = []
    done = CliRunner().invoke(program(kind, found), words)
    refused = isinstance(done.exception, ConfigError) or done.exit_code == 2
    shown = "" if refused else done.output
    return refused, shown, [{name: repr(value) for name, value in one.items()} for one in found]


TEXTS = st.one_of(
    st.sampled_from(
        ["a", "", "-", "--", "/", "/nowhere", "/etc/shadow", "5", "12", "007", "-3", "+5", "1_0", "9" * 19]
        + ["1.5", "-1e3", ".5", "1e999", "nan", "inf", " 7", "true", "none", "٣"]
    ),
    st.text(string.printable, max_size=5),
)
OPTIONS = st.sampled_from(
    ["--word", "--whole", "--least", "--maybe", "--real", "--inject", "--nth", "--trust", "--out", "--known"]
)
WORDS = st.one_of(
    st.tuples(OPTIONS, TEXTS),
    st.builds(lambda option, text: (f"{option}={text}",), OPTIONS, TEXTS),
    st.sampled_from([("--pin",), ("--no-pin",), ("--json",), ("--help",), ("--wor", "a"), ("--json=1",)]),
    st.tuples(TEXTS),
)


@given(st.lists(WORDS, max_size=5).map(lambda parts: ["here", *(word for part in parts for word in part)]))
@example([])
@example(["here", "--nth", "3", "--nth", "4", "--trust", "x", "--no-pin", "--real", "2.5"])
@example(["--whole", "5", "here", "there"])
@example(["here", "--whole", "a"])
@example(["here", "--whole", "1_0"])
@example(["here", "--nth", "5a"])
@example(["here", "--least", "9"])
@example(["here", "--real", "1e999"])
@example(["here", "--real", "e5"])
@example(["here", "--known", "/nowhere"])
def test_values_are_those_of_typer_and_as_much_is_refused(words: list[str]) -> None:
    assert outcome(PlainCommand, words) == outcome(TyperCommand, words)


@pytest.mark.parametrize(
    ("words", "plain"),
    [
        (["x", "--word", "lfr", "--whole", "3", "--real", "1.5", "--json", "--nth", "7", "--out", "y"], True),
        (["x", "--least", "11"], True),
        (["x", "--least", "9"], False),
        (["x", "--known", "/"], False),
        (["x", "--whole", "1_0"], False),
    ],
)
def test_what_is_plain_is_not_converted_by_typer(
    words: list[str], plain: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []
    typers = TyperCommand.parse_args

    def parse_args(self: TyperCommand, ctx: object, args: list[str]) -> object:
        asked.append(args)
        return typers(self, ctx, args)  # type: ignore[arg-type]

    monkeypatch.setattr(TyperCommand, "parse_args", parse_args, raising=False)
    outcome(PlainCommand, words)
    assert bool(asked) is not plain
