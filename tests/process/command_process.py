"""A command of the tests in a process that was forked for it; see `liveruns.forked`."""

import mmap
import os
import resource
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from aftbed.cli import main

_MARKS: Final[list[mmap.mmap]] = []


def mark(home: str) -> None:
    """Mark this process and what it will fork as belonging to the home of a test."""
    descriptor = os.memfd_create(home)
    os.ftruncate(descriptor, mmap.PAGESIZE)
    _MARKS.append(mmap.mmap(descriptor, mmap.PAGESIZE))
    os.close(descriptor)


def run(
    words: list[str], environment: Mapping[str, str], folder: Path, out: Path, err: Path, session: bool
) -> None:
    """Become the command `words`, as an interpreter would. Ends with SystemExit or not at all.

    `session`: it has one of its own.
    """
    if session:
        os.setsid()
    os.closerange(3, resource.getrlimit(resource.RLIMIT_NOFILE)[0])
    for number, (path, flags) in enumerate(
        ((os.devnull, os.O_RDONLY), (out, os.O_WRONLY | os.O_CREAT), (err, os.O_WRONLY | os.O_CREAT))
    ):
        opened = os.open(path, flags, 0o600)
        os.dup2(opened, number)
        os.close(opened)
    sys.stdin, sys.stdout, sys.stderr = os.fdopen(0), os.fdopen(1, "w"), os.fdopen(2, "w")
    os.environ.clear()
    os.environ.update(environment)
    mark(environment["XDG_RUNTIME_DIR"])
    os.chdir(folder)
    sys.argv = words
    main()
