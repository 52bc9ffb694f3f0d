"""Opens zip archives that others have made: an FMU, a bundle of evidence.

Sizes are checked before anything is unpacked, and a member that is read gives no more than it says. Names are
paths below the archive: whatever unpacks them stays in its directory.
"""

import contextlib
import os
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

import msgspec

from aftbed.core.errors import ConfigError
from aftbed.core.input_file import open_input

METHODS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


class ArchiveLimits(msgspec.Struct, frozen=True):
    """What an archive may have."""

    archive_bytes_max: int
    unpacked_bytes_max: int
    members_max: int


@contextlib.contextmanager
def opened_archive(
    path: Path, what: str, limits: ArchiveLimits
) -> Iterator[tuple[BinaryIO, zipfile.ZipFile]]:
    """The archive, its members checked. `what` it should be: "an FMU".

    Raises ConfigError, also for what goes wrong with it in the block.
    """
    try:
        with open_input(path) as file:
            size_bytes = os.fstat(file.fileno()).st_size
            if size_bytes > limits.archive_bytes_max:
                raise ConfigError(f"{path}: found {size_bytes} bytes, allowed are {limits.archive_bytes_max}")
            with zipfile.ZipFile(file) as archive:
                _check_members(path, what, archive, limits)
                yield file, archive
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (zipfile.BadZipFile, zlib.error, EOFError, struct.error, ValueError, LookupError) as error:
        raise ConfigError(f"{path}: found no zip archive, as {what} is, or a broken one") from error
    except (NotImplementedError, RuntimeError) as error:  # a version of the format, encrypted
        raise ConfigError(f"{path}: its archive cannot be read: {error}") from error


def _check_members(path: Path, what: str, archive: zipfile.ZipFile, limits: ArchiveLimits) -> None:
    members = archive.infolist()
    if len(members) > limits.members_max:
        raise ConfigError(f"{path}: found {len(members)} members, allowed are {limits.members_max}")
    total = sum(one.file_size for one in members)
    if total > limits.unpacked_bytes_max:
        raise ConfigError(
            f"{path}: found {total} bytes when unpacked, allowed are {limits.unpacked_bytes_max}"
        )
    seen: set[str] = set()
    for one in members:
        name = one.orig_filename
        parts = name.removesuffix("/").split("/")
        if "\\" in name or "\0" in name or any(part in ("", ".", "..") for part in parts):
            below = what.partition(" ")[2]
            raise ConfigError(
                f"{path}: found the member {name!r}, allowed are paths below the {below}, with slashes"
            )
        if stat.S_IFMT(one.external_attr >> 16) not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise ConfigError(f"{path}: found {name!r}, a link or device, allowed are files and directories")
        if one.compress_type not in METHODS:
            raise ConfigError(
                f"{path}: found {name!r} compressed by method {one.compress_type}, allowed are 0 (stored)"
                " and 8 (deflated)"
            )
        if name in seen:
            raise ConfigError(f"{path}: found the member {name!r} twice, allowed is once")
        seen.add(name)
