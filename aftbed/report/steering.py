"""Words for a live run, from a page or a view: the commands `inject`, `adapt` and `stop`.

Each is the command itself, in a process and a session of its own, so it does and answers what it would do at
a second terminal, and a Ctrl-C is not for it. It dies with the thread that started it.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from aftbed.core.errors import ConfigError

COMMANDS: Final = ("adapt", "inject", "stop")
COMMAND_S_MAX: Final = 20.0
ANSWER_CHARACTERS_MAX: Final = 4000
NICE: Final = 10  # an interpreter's start is a burst of work, and the run must not wait for it


def child_command(words: Sequence[str], private: Path) -> list[str]:
    """The command line of `aftbed WORDS` for the run in `private`. Raises ConfigError for other commands."""
    first = words[0] if words else "nothing"
    if first not in COMMANDS:
        raise ConfigError(f"{first}: {', '.join(COMMANDS)} are allowed here")
    return [sys.executable, "-m", "aftbed.cli.child", str(os.getpid()), *words, "--run", private.name]


def start_command(words: Sequence[str], private: Path) -> "subprocess.Popen[str]":
    """The same, started, with its output in a pipe."""
    process = subprocess.Popen(
        child_command(words, private),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    os.setpriority(os.PRIO_PROCESS, process.pid, NICE)
    return process
