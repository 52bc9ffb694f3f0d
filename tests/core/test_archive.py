"""Zip archives that others have made: whatever is in them, they are read within limits or refused."""

import io
import zipfile
from pathlib import Path
from typing import Final

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from aftbed.core.archive import ArchiveLimits, opened_archive
from aftbed.core.errors import ConfigError

LIMITS: Final = ArchiveLimits(archive_bytes_max=10_000, unpacked_bytes_max=5_000, members_max=4)


def zipped(*names: str, data: bytes = b"some data" * 9, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name in names:
            archive.writestr(name, data)
    return file.getvalue()


def read(path: Path, data: bytes) -> dict[str, bytes]:
    """All that is in it. Raises ConfigError."""
    path.write_bytes(data)
    with opened_archive(path, "a bundle", LIMITS) as (_, archive):
        return {one.filename: archive.read(one) for one in archive.infolist()}


def test_what_is_within_the_limits_is_read(tmp_path: Path) -> None:
    assert read(tmp_path / "a.zip", zipped("a", "b/c")).keys() == {"a", "b/c"}


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (zipped(*"abcde"), "found 5 members, allowed are 4"),
        (zipped("a", data=bytes(5_001)), "found 5001 bytes when unpacked, allowed are 5000"),
        (bytes(10_001), "found 10001 bytes, allowed are 10000"),
        (zipped("../a"), "found the member '../a', allowed are paths below the bundle"),
        (zipped("a", method=zipfile.ZIP_LZMA), "found 'a' compressed by method 14, allowed are 0 (stored)"),
        (b"", "found no zip archive, as a bundle is, or a broken one"),
    ],
    ids=["members", "unpacked", "bytes", "path", "method", "empty"],  # an archive has the time in it
)
def test_what_is_not_is_refused(tmp_path: Path, data: bytes, why: str) -> None:
    with pytest.raises(ConfigError) as refused:
        read(tmp_path / "a.zip", data)
    assert str(refused.value).startswith(f"{tmp_path}/a.zip: {why}")


GOOD: Final = zipped("a", "b/c")


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    cuts=st.lists(
        st.tuples(st.integers(0, len(GOOD)), st.integers(0, 9), st.binary(max_size=9)), min_size=1, max_size=4
    )
)
@example(cuts=[(0, 9, b"")])
def test_whatever_is_changed_in_it_nothing_but_a_config_error_comes_of_it(
    tmp_path: Path, cuts: list[tuple[int, int, bytes]]
) -> None:
    data = GOOD
    for at, length, put in cuts:
        data = data[:at] + put + data[at + length :]
    try:
        found = read(tmp_path / "a.zip", data)
    except ConfigError:
        return
    assert sum(map(len, found.values())) <= LIMITS.unpacked_bytes_max
