"""`aftbed completion bash|zsh|fish`: the script that has a shell complete the words of aftbed.

The scripts are in `shells/`. They call `aftbed completion answer -- WORDS` at each TAB, with the words up to
the cursor as they were typed, the last one unfinished; `completer` has the answer.
"""

import faulthandler
import os
from pathlib import Path
from typing import Annotated, Final

import typer

from aftbed.cli.parsing import PlainGroup

SHELLS: Final = Path(__file__).resolve().parent / "shells"
SECONDS_MAX: Final = 10.0  # whatever blocks that should not, a shell gets its prompt back

completion = typer.Typer(cls=PlainGroup)


def _shell_command(shell: str, where: str) -> None:
    about = f"Print the script for {shell}."

    @completion.command(shell, help=f"{about}\n\n{where}")
    def script() -> None:
        typer.echo((SHELLS / f"aftbed.{shell}").read_text(), nl=False)


_shell_command(
    "bash",
    'In this shell: eval "$(aftbed completion bash)". In each one: this line in ~/.bashrc; or, with'
    " bash-completion, the script as ~/.local/share/bash-completion/completions/aftbed.",
)
_shell_command(
    "zsh",
    'In this shell: eval "$(aftbed completion zsh)". In each one: this line in ~/.zshrc, behind compinit; or'
    " the script as _aftbed in a directory of $fpath.",
)
_shell_command(
    "fish",
    "In this shell: aftbed completion fish | source. In each one: the script as"
    " ~/.config/fish/completions/aftbed.fish.",
)


@completion.command(hidden=True)
def answer(words: Annotated[list[str] | None, typer.Argument()] = None) -> None:
    """For the scripts: what may stand at the end of WORDS."""
    from aftbed.cli.completer import complete  # noqa: PLC0415 - the scripts need none of it

    with open(os.devnull, "w") as null:
        faulthandler.dump_traceback_later(SECONDS_MAX, exit=True, file=null)
        try:
            lines = complete(words or [""]).lines()
        finally:
            faulthandler.cancel_dump_traceback_later()
    typer.echo("\n".join(lines))
