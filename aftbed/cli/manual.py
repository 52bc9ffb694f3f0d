"""`aftbed man`: the manual page, made of the commands and their options, so that it says what `--help` says.

It is roff in the macros of man(7), which man-db, groff and mandoc read without a warning.
"""

import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from typing import Any, Final

import typer

from aftbed import __version__
from aftbed.cli.app import app
from aftbed.cli.lazy import LazyCommand

ABOUT: Final = "testbed for adaptive fault tolerance"
DESCRIPTION: Final = (
    "A function is protected by a fault tolerance mechanism that runs in real processes and can be changed"
    " while it serves. aftbed injects faults, and says by checks and with intervals what became of them. The"
    " built-in function is an emergency brake between a radar and a brake ECU on a CAN bus.",
    "Commands that talk to a live run (status, ps, graph, web, inject, adapt, stop) take --run with the id of"
    " the run, or its beginning, where several are alive.",
)
EXIT_STATUS: Final = (
    ("0", "Pass: every promise was checked and held; or the command did what it was asked for."),
    ("1", "Fail: a promise was broken, a gate did not pass, an adaptation was rolled back."),
    ("2", "Usage: an unknown name, a wrong value, an unreadable file, no live run."),
    ("3", "Inconclusive: trouble of the harness, or a fault or an adaptation that did not happen."),
    ("130", "Interrupted, and cleaned up."),
    ("141", "The output has no reader any more; cleaned up."),
)
ENVIRONMENT: Final = (
    ("XDG_RUNTIME_DIR", "Runs have their directories below it."),
    ("TMPDIR", "Where they are if that is not set; /dev/shm or /tmp without both."),
    ("XDG_STATE_HOME", "Below it aftbed keeps the hashes of functions that this user has run."),
    ("PYTHONPATH", "Where functions of a user are looked for, as Python does."),
    ("NO_COLOR", "If it is set, nothing is coloured."),
)
FILES: Final = (
    (
        "$XDG_RUNTIME_DIR/aftbed/ID, /dev/shm/aftbed-UID/ID, /tmp/aftbed-UID/ID",
        "The private directory of a run: its control socket.",
    ),
    ("DIR of --record", "The record of a run; aftbed check judges it again."),
    ("$XDG_STATE_HOME/aftbed, ~/.local/state/aftbed", "The hashes of what this user has run."),
    ("campaign-NAME", "Plan, ledger, records and reports of a campaign, if --out does not say."),
)
EXAMPLES: Final = (
    ("A drive in which the primary dies:", 'aftbed run --inject "crash primary at checkpoint.sent nth 100"'),
    ("The same in virtual time, a thousand seeds:", "aftbed sim --swarm --seeds 0..999"),
    ("A fault and a change of mechanism from a second terminal:", "aftbed inject crash primary"),
    ("", "aftbed adapt compose pbr+tr"),
    ("Ten thousand crashes with confidence intervals:", "aftbed campaign run crash --out found"),
    ("Words that the shell completes:", 'eval "$(aftbed completion bash)"'),
)
ESCAPES: Final = {  # the backslash first
    "\\": r"\e",
    "-": r"\-",
    "'": r"\(aq",
    '"': r"\(dq",
    "`": r"\(ga",
    "^": r"\(ha",
    "~": r"\(ti",
}
WIDTH: Final = 62  # of a line, before what is replaced makes it longer
SEE_ALSO: Final = ("python(1), candump(1), systemd-run(1)", "The pages in docs/ of the source.")


def man() -> None:
    """The manual page: commands, options, exit codes, files.

    On a terminal man(1) shows it; else it is printed, as roff.
    """
    page = manual_page()
    shown = sys.stdout.isatty() and shutil.which("man") is not None
    if shown and subprocess.run(["man", "-l", "-"], input=page.encode(), check=False).returncode == 0:
        return
    sys.stdout.write(page)


def manual_page() -> str:
    """All of it, in ASCII."""
    return "".join(f"{line}\n" for line in _lines())


def _lines() -> Iterator[str]:
    yield rf'.TH AFTBED 1 "" "aftbed {_text(__version__)}" "User Commands"'
    yield ".nh"  # names of options are searched for
    yield from (".SH NAME", rf"aftbed \- {ABOUT}")
    yield from (".SH SYNOPSIS", ".B aftbed", r".I COMMAND", "[OPTIONS] [ARGUMENTS]")
    yield ".SH DESCRIPTION"
    yield from list(_paragraphs("\n\n".join(DESCRIPTION)))[1:]
    yield ".SH COMMANDS"
    for path, command in _commands(typer.main.get_command(app), "aftbed"):
        yield from _command(path, command)
    for title, rows in (("EXIT STATUS", EXIT_STATUS), ("ENVIRONMENT", ENVIRONMENT), ("FILES", FILES)):
        yield f".SH {title}"
        for name, about in rows:
            yield from (".TP", rf"\fB{_text(name)}\fR", *_filled(about))
    yield ".SH EXAMPLES"
    for about, line in EXAMPLES:
        yield from ([".PP"] * (about != EXAMPLES[0][0]) + _filled(about) if about else [])
        yield from _literal([line])
    yield ".SH SEE ALSO"
    yield from list(_paragraphs("\n\n".join(SEE_ALSO)))[1:]


def _commands(group: Any, path: str) -> Iterator[tuple[str, Any]]:
    """What can be called, with its path: no group."""
    for name, inner in group.commands.items():
        command = inner.load() if isinstance(inner, LazyCommand) else inner
        if command.hidden:
            continue
        if hasattr(command, "commands"):
            yield from _commands(command, f"{path} {name}")
        else:
            yield f"{path} {name}", command


def _command(path: str, command: Any) -> Iterator[str]:
    """As its help has it, in the same order."""
    context = typer.Context(command, info_name=path)
    yield f".SS {_text(path)}"
    yield rf"\fB{_text(path)}\fR {_text(' '.join(command.collect_usage_pieces(context)))}"
    yield from _paragraphs(command.help or "")
    for one in command.get_params(context):
        record = one.get_help_record(context)
        if record is not None and "--help" not in one.opts:
            yield from (".TP", rf"\fB{_text(record[0])}\fR", *_filled(record[1]))
    yield from _paragraphs(command.epilog or "")


def _paragraphs(text: str) -> Iterator[str]:
    r"""Each begins with a `.PP`. A line of `\b` alone keeps the lines below it as they are, as in typer."""
    for paragraph in filter(None, re.split(r"\n\s*\n", text.strip())):
        lines = paragraph.strip().splitlines()
        yield ".PP"
        if lines[0].strip() == "\b":
            yield from _literal(lines[1:])
        else:
            yield from _filled(paragraph)


def _literal(lines: list[str]) -> list[str]:
    """Lines that stay as they are."""
    return [".RS 4", ".nf", *(_text(line.strip()) for line in lines), ".fi", ".RE"]


def _filled(words: str) -> list[str]:
    """In lines that an editor shows; man(1) fills them again."""
    return [_text(line) for line in textwrap.wrap(words, WIDTH, break_on_hyphens=False)]


def _text(words: str) -> str:
    """With what means something to roff replaced, and other characters than ASCII by their code points."""
    for plain, replaced in ESCAPES.items():
        words = words.replace(plain, replaced)
    words = "".join(one if one.isascii() else rf"\[u{ord(one):04X}]" for one in words)
    return rf"\&{words}" if words.startswith(".") else words
