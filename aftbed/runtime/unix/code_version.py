"""Which code this is: what a record or a campaign says of itself, so that its figures can be had again."""

import hashlib
from functools import lru_cache
from pathlib import Path

import aftbed


@lru_cache(maxsize=8)
def code_version(packages: tuple[str, ...] = ()) -> str:
    """The version of the package, and a digest of its code: a changed line makes it another one.

    `packages`: others with a part in it, by name and version.
    """
    home, digest = Path(aftbed.__file__).parent, hashlib.sha256()
    for path in sorted(home.rglob("*.py")):
        digest.update(path.relative_to(home).as_posix().encode() + path.read_bytes())
    return " ".join((f"{aftbed.__version__}+{digest.hexdigest()[:8]}", *packages))
