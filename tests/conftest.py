"""What all tests share: how long hypothesis looks, and how golden files are rewritten.

Profiles: `dev` (default: few examples), `ci` (the same few each time; taken where `CI` is set), `deep` (many;
`make deep`). None has a deadline per example: a busy machine is no failing test.
A failing example prints the line that repeats it.
"""

import gc
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from hypothesis import HealthCheck, settings

ID_MAX: Final = 60  # characters of a parameter in the name of its test: some are megabytes
GC_THRESHOLD: Final = 20_000  # new objects; tests make few cycles, and with 700 the collector takes 4 %
_SLOW_IS_FINE = (HealthCheck.too_slow,)

settings.register_profile(
    "dev", max_examples=25, deadline=None, print_blob=True, suppress_health_check=_SLOW_IS_FINE
)
settings.register_profile("ci", settings.get_profile("dev"), derandomize=True)
settings.register_profile("deep", settings.get_profile("dev"), max_examples=5_000)
settings.load_profile("ci" if os.environ.get("CI") else "dev")

# A shell without job control starts what is behind `&` with SIGINT ignored, and commands under test would
# inherit that: an interrupt would do nothing.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--rewrite", action="store_true", help="write the golden dialogues anew")


def pytest_make_parametrize_id(val: object) -> str | None:
    return f"{val[:ID_MAX]!r}..." if isinstance(val, str | bytes) and len(val) > ID_MAX else None


@pytest.hookimpl(tryfirst=True)  # pytest-xdist reads the marks in the same hook
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A file stays in one worker under `--dist loadgroup`, unless its tests name groups of their own."""
    for item in items:
        if item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(item.nodeid.partition("::")[0]))


def pytest_collection_finish() -> None:
    """What is collected lives to the end: the garbage collector need not go over thousands of tests again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(GC_THRESHOLD)


@pytest.fixture(scope="session", autouse=True)
def state_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The XDG_STATE_HOME of the tests: what their runs execute is not remembered for the user here."""
    with pytest.MonkeyPatch.context() as patch:
        path = tmp_path_factory.mktemp("state")
        patch.setenv("XDG_STATE_HOME", str(path))
        yield path


@pytest.fixture
def rewrite(request: pytest.FixtureRequest) -> bool:
    """Whether golden files are to be written instead of compared."""
    return bool(request.config.getoption("--rewrite"))
