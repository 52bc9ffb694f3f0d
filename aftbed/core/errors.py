"""Error classes by what has to change: the input of the user, a peer, or our code.

`ConfigError` and `ScriptError` are for the user (exit code 2), `PeerError` is for a frame or a message that
must not be believed, `HarnessError` for trouble of the testbed itself (exit code 3, never a pass: G8). A
failed `assert` is a bug of ours: it ends the node, because fail-silence is the fault model.
"""

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

FUNCTION_FAILED: Final = "the function failed: "  # begins why its node has stopped


class AftbedError(Exception):
    """Base of all errors that aftbed raises on purpose; its text is fit to be shown."""


class ConfigError(AftbedError):
    """The user asked for something that does not exist or is not allowed: exit code 2."""


class FileKeyError(ConfigError):
    """What stands at `key` of a file, as `faults[0].name`, is not allowed.

    The reader of the file adds its name, line and column: `core.yaml_file.in_file`.
    """

    def __init__(self, key: str, reason: object) -> None:
        super().__init__(f"{key}: {reason}")
        self.key = key


@contextlib.contextmanager
def at_key(key: str) -> Iterator[None]:
    """A ConfigError within it is one about what stands at `key` of a file."""
    try:
        yield
    except ConfigError as error:
        raise FileKeyError(key, error) from error


class ScriptError(ConfigError):
    """An adaptation script that is refused before its first step: exit code 2."""


class PeerError(AftbedError):
    """A peer sent what it may not send. The receiver's state is unchanged."""


class StepFailed(Exception):  # noqa: N818 - a situation within a task, never shown as it is
    """Within a task of the runtime: a step was refused, its process died, or its deadline passed."""


class FunctionFailedError(AftbedError):
    """The protected function broke its contract, or ended: its replica stops. The text is fit to be shown."""


class HarnessError(AftbedError):
    """The testbed itself is in trouble: the verdict is inconclusive, exit code 3."""


def function_failed(why: object) -> str:
    """Why a node has stopped, in one line, as the judge looks for it in what the processes printed."""
    return FUNCTION_FAILED + " | ".join(str(why).splitlines())


def shown(text: str) -> str:
    """A text that others may have written, fit for a terminal: it cannot move the cursor or ask for anything.

    Control characters but newlines become U+FFFD, as does what changes the direction of writing.
    """
    return "".join(one if one.isprintable() or one == "\n" else "\ufffd" for one in text)


def spreadsheet_text(text: str) -> str:
    """A text that others may have written, fit for a CSV: a spreadsheet takes it for no formula.

    A carriage return becomes a newline: `csv` does not quote it, and a reader would end the row there.
    """
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t")) else text


def unknown(
    what: str, found: str, allowed: Iterable[str], synonyms: Mapping[str, str] | None = None
) -> ConfigError:
    """A `ConfigError` that names what was found, the nearest name that exists, and all allowed.

    `synonyms`: what words mean that others use for the same.
    """
    import difflib  # noqa: PLC0415 - every process imports this module, and few need that

    names = sorted(allowed)
    by_lower = {name.lower(): name for name in names}
    meant = (synonyms or {}).get(found.lower())
    near = [meant] if meant in names else difflib.get_close_matches(found.lower(), by_lower, n=1, cutoff=0.5)
    hint = f"; did you mean {by_lower[near[0].lower()]!r}?" if near else ""
    return ConfigError(f"unknown {what} {found!r}{hint} (one of: {', '.join(names)})")
