"""The examples of docs/functions.md, and a C compiler."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from aftbed.functions.library import HEADER

HERE: Final = Path(__file__).parent
PAGE: Final = HERE.parents[1] / "docs" / "functions.md"
PYTHON: Final = f"{sys.executable} -I -S"  # starts within 15 ms


def example(name: str) -> str:
    """The file that the page shows as `name`."""
    found = re.search(rf"^```\w+ file={re.escape(name)}\n(.*?)^```", PAGE.read_text(), re.M | re.S)
    assert found, f"{PAGE.name} has no example {name}"
    return found[1]


def compiled(source: Path, *options: str) -> Path:
    """The shared library of a C or C++ file, beside it. Skips the test where there is no compiler."""
    variable, names = (
        ("CXX", ("c++", "g++", "clang++")) if source.suffix == ".cpp" else ("CC", ("cc", "gcc", "clang"))
    )
    compiler = os.environ.get(variable) or next((one for one in names if shutil.which(one)), None)
    if compiler is None:
        pytest.skip(f"there is no compiler ({', '.join(names)})")
    library = source.with_suffix(".so")
    warnings = ("-Wall", "-Wextra", "-Wno-unused-parameter", "-Werror", "-fvisibility=hidden")
    line = (
        *shlex.split(compiler),
        "-shared",
        "-fPIC",
        *warnings,
        "-I",
        HEADER.parent,
        *options,
        "-o",
        library,
        source,
    )
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return library


def program(name: str, *arguments: str) -> str:
    """The command line of a Python program here."""
    return f"{PYTHON} {shlex.join([str(HERE / name), *arguments])}"
