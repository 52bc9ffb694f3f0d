"""The seal of a record that is kept: the SHA-256 of each of its files, written when the run has ended.

It shows that a file was changed, cut or removed since, by accident or by hand. It is no signature: a user
that can write the record can write another seal, so the judge compares the sources with each other, too.
`chain` is one value for the whole record, to be noted elsewhere: the hash of the names and hashes of the
files, in order.

A record without a seal is that of a run whose command did not live to write it.
"""

import hashlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import msgspec

from aftbed.core.input_file import open_input, read_input
from aftbed.runtime.unix.interrupts import scratch_directory
from aftbed.runtime.unix.journal_files import trim

NAME: Final = "seal.json"
SEAL_BYTES_MAX: Final = 4_000_000
PART_BYTES: Final = 1 << 20


class Seal(msgspec.Struct, frozen=True):
    """`files`: the SHA-256, in hexadecimal, by path within the record."""

    files: dict[str, str]
    chain: str


def write(record: Path) -> None:
    """Seal the record as it is. Raises OSError."""
    files = {
        str(path.relative_to(record)): _hash(path)
        for path in sorted(record.rglob("*"))
        if path.is_file() and path.name != NAME
    }
    (record / NAME).write_bytes(msgspec.json.format(msgspec.json.encode(Seal(files, chain(files)))))


def copy_sealed(record: Path, target: Path) -> None:
    """Make `target`, a sealed copy of the record of a run that has ended, whole or not. Raises OSError."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with scratch_directory(f".{target.name}.", target.parent) as folder:
        beside = folder / target.name
        shutil.copytree(record, beside, symlinks=True)
        trim(beside / "journal")
        write(beside)
        beside.rename(target)


def chain(files: dict[str, str]) -> str:
    """One hash for all files."""
    link = ""
    for name in sorted(files):
        link = hashlib.sha256(f"{link} {name} {files[name]}".encode()).hexdigest()
    return link


def sealed(record: Path) -> bool:
    return (record / NAME).exists()


def changes(record: Path) -> Iterator[str]:
    """What was changed since the record was sealed; nothing where it was not. A new file changes nothing."""
    if not sealed(record):
        return
    try:
        seal = msgspec.json.decode(read_input(record / NAME, SEAL_BYTES_MAX), type=Seal)
    except (OSError, ValueError, msgspec.MsgspecError, RecursionError):
        yield f"{NAME} is not a seal"
        return
    if seal.chain != chain(seal.files):
        yield f"{NAME} was changed: its chain is not that of its files"
    for name, expected in seal.files.items():
        path = record / name
        if not path.resolve().is_relative_to(record.resolve()) or not path.is_file():
            yield f"{name} was removed since the record was sealed"
        elif _hash(path) != expected:
            yield f"{name} was changed since the record was sealed"


def _hash(path: Path) -> str:
    digest = hashlib.sha256()
    with open_input(path) as file:
        while part := file.read(PART_BYTES):
            digest.update(part)
    return digest.hexdigest()
