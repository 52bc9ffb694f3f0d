"""Words for a live run, from a page or a view: the commands `inject`, `adapt` and `stop`.

Each is the command itself, in a process of its own, so it does and answers what it would do at a second
terminal. It dies with the process that asked for it.
"""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from aftbed.core.errors import ConfigError

COMMANDS: Final = ("adapt", "inject", "stop")
COMMAND_S_MAX: Final = 20.0
ANSWER_CHARACTERS_MAX: Final = 4000


def child_command(words: Sequence[str], private: Path) -> list[str]:
    """The command line of `aftbed WORDS` for the run in `private`. Raises ConfigError for other commands."""
    first = words[0] if words else "nothing"
    if first not in COMMANDS:
        raise ConfigError(f"{first}: {', '.join(COMMANDS)} are allowed here")
    return [sys.executable, "-m", "aftbed.cli.child", str(os.getpid()), *words, "--run", private.name]
