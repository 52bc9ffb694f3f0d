"""TAB in real shells, each on a terminal of its own.

What a shell has made of a line is read where it is certain: at the end `show` is put before it, a function
that writes its arguments to a file. A shell takes the keys one after the other, so nothing has to be waited
for between them. A shell that is not installed is skipped: Debian brings only bash.
"""

import os
import pty
import select
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from liveruns import Home

SECONDS_MAX: Final = 60.0  # for a shell on a busy machine
PROMPT: Final = "ready> "
PLACED: Final = ["aftbed", "run", "--placement", "single", "--ftm", "pbr+tr"]
TO_BEGIN: Final = "\x01"  # of the line
BASH: Final = """
PS1='{prompt}'
bind 'set enable-bracketed-paste off'
show() {{ printf '%s\\n' "$@" > words; echo shown; }}
eval "$(aftbed completion bash)"
"""
ZSH: Final = """
PS1='{prompt}'
unsetopt zle_bracketed_paste prompt_sp
unset zle_bracketed_paste
bindkey -e
autoload -Uz compinit
compinit -D -u
show() {{ printf '%s\\n' "$@" > words; echo shown; }}
eval "$(aftbed completion zsh)"
"""
FISH: Final = """
function fish_prompt; echo -n '{prompt}'; end
function fish_greeting; end
function show; printf '%s\\n' $argv > words; echo shown; end
aftbed completion fish | source
"""
SHELLS: Final = {  # the file that it reads at its start, what is in it, and its command
    "bash": ("rc", BASH, ["bash", "--noprofile", "--rcfile", "{folder}/rc", "-i"]),
    "zsh": (".zshrc", ZSH, ["zsh", "-d", "-i"]),
    "fish": ("fish/config.fish", FISH, ["fish", "-i"]),
}

pytestmark = pytest.mark.process


class Shell:
    """A shell on a terminal."""

    def __init__(self, name: str, folder: Path) -> None:
        file, text, command = SHELLS[name]
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / file).write_text(text.format(prompt=PROMPT))
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        environment = os.environ | {"TERM": "dumb", "PATH": path, "HOME": str(folder)}
        environment |= {"ZDOTDIR": str(folder), "XDG_CONFIG_HOME": str(folder), "COLUMNS": "200"}
        self._folder = folder
        self._pid, self._terminal = pty.fork()
        if self._pid == 0:
            os.chdir(folder)
            os.execvpe(command[0], [word.format(folder=folder) for word in command], environment)
        self._until(PROMPT)

    def line(self, keys: str) -> list[str]:
        """The words of the command line that `keys` make, with `\t` where TAB is pressed."""
        os.write(self._terminal, f"{keys}{TO_BEGIN}show \r".encode())
        self._until("shown\r\n")
        return (self._folder / "words").read_text().splitlines()

    def _until(self, text: str) -> str:
        """What the shell prints, up to `text`."""
        found, limit = "", time.monotonic() + SECONDS_MAX
        while text not in found:
            wait = max(0.0, limit - time.monotonic())
            assert select.select([self._terminal], [], [], wait)[0], f"{text!r} never came: {found}"
            found += os.read(self._terminal, 1 << 16).decode(errors="replace")
        return found

    def end(self) -> None:
        os.kill(self._pid, signal.SIGKILL)
        os.waitpid(self._pid, 0)
        os.close(self._terminal)


@pytest.fixture(params=list(SHELLS))
def shell(request: pytest.FixtureRequest, home: Home, tmp_path: Path) -> Iterator[Shell]:
    if shutil.which(request.param) is None:
        pytest.skip(f"{request.param} is not installed")
    found = Shell(request.param, tmp_path)
    yield found
    found.end()


def test_words_are_completed_at_a_tab(shell: Shell, tmp_path: Path) -> None:
    assert shell.line("aftbed scen\tru\tccrs-2\t") == ["aftbed", "scenario", "run", "ccrs-20"]
    assert shell.line("aftbed run --placem\tsin\t--ftm pbr+t\t") == PLACED
    in_quotes = shell.line('aftbed sim --inject "crash pri\tat server.ex\tnth 3"')
    assert in_quotes == ["aftbed", "sim", "--inject", "crash primary at server.exit nth 3"]
    (tmp_path / "my drive.yaml").touch()
    assert shell.line("aftbed run --scenario my\t") == ["aftbed", "run", "--scenario", "my drive.yaml"]
