"""C libraries: the contract of `aft.h`, and what is said of a library that breaks it."""

import ctypes
import gc
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

import pytest
from examples import HERE, compiled, example

from aftbed.core.application import (
    EXACT,
    NONE,
    REPLY_BYTES_MAX,
    STATE_BYTES_MAX,
    Application,
    Characteristics,
    approximate,
)
from aftbed.core.errors import ConfigError, PeerError
from aftbed.functions.library import HEADER, LibraryFailedError, LibraryFunction, library_function

REQUIRED: Final = ("aft_init", "aft_execute", "aft_state_size", "aft_capture", "aft_restore")
Build = Callable[..., Path]


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """`faulty.c`, built with options."""

    def make(*options: str) -> Path:
        source = tmp_path_factory.mktemp("library") / "faulty.c"
        source.write_bytes((HERE / source.name).read_bytes())
        return compiled(source, *options)

    return make


@pytest.fixture(scope="module")
def faulty(build: Build) -> Callable[[], Application]:
    return library_function(build())


@pytest.fixture
def function(faulty: Callable[[], Application]) -> Application:
    return faulty()


@pytest.fixture(scope="module")
def example_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = tmp_path_factory.mktemp("example") / "sum.c"
    source.write_text(example(source.name))
    return compiled(source)


def test_the_example_of_the_page_adds_up(example_library: Path) -> None:
    one = library_function(example_library)()
    assert one.characteristics == Characteristics(deterministic=True, state_access=EXACT)
    assert [one.execute(bytes([n])) for n in (1, 255, 7)] == [
        bytes((n, h, 0, 0)) for n, h in ((1, 0), (0, 1), (7, 1))
    ]
    assert one.capture() == bytes((7, 1, 0, 0))
    with pytest.raises(PeerError, match=r"sum\.so: refuses the request of 2 bytes"):
        one.execute(b"12")
    with pytest.raises(PeerError, match=r"sum\.so: refuses the state of 3 bytes"):
        one.restore(b"123")
    assert one.capture() == bytes((7, 1, 0, 0))
    assert one.acceptable(b"1", b"anything"), "without an assertion every reply is acceptable"


def test_instances_are_independent_and_a_state_goes_from_one_to_the_other(example_library: Path) -> None:
    one, other = library_function(example_library)(), library_function(example_library)()
    one.execute(b"\x05")
    other.execute(b"\x07")
    assert (one.capture(), other.capture()) == (b"\x05\0\0\0", b"\x07\0\0\0")
    other.restore(one.capture())
    assert other.execute(b"\x01") == b"\x06\0\0\0" and one.capture() == b"\x05\0\0\0"


def test_the_header_has_the_limits_of_the_runtime(tmp_path: Path) -> None:
    source = tmp_path / "limits.c"
    source.write_text(
        f'#include "{HEADER}"\n'
        f'_Static_assert(AFT_REPLY_BYTES_MAX == {REPLY_BYTES_MAX}, "of a reply");\n'
        f'_Static_assert(AFT_STATE_BYTES_MAX == {STATE_BYTES_MAX}, "of a state");\n'
    )
    compiled(source, "-std=c11", "-pedantic")


def test_the_functions_may_be_written_in_cpp(tmp_path: Path) -> None:
    source = tmp_path / "written.cpp"
    source.write_text(f'#include "{HEADER}"\nint aft_init(void **instance) {{ return AFT_OK; }}\n')
    assert hasattr(ctypes.CDLL(str(compiled(source))), "aft_init"), "exported, and by its own name"


# -- what is no such library ----------------------------------------------------------------------


def test_a_file_that_is_missing_or_no_library_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.so: cannot be read: No such file or directory"):
        library_function(tmp_path / "none.so")
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        library_function(tmp_path)
    text = tmp_path / "text.so"
    text.write_text("int main() {}")
    with pytest.raises(
        ConfigError, match=r"text\.so: no shared library: it begins with b'int ', an ELF file"
    ):
        library_function(text)
    text.write_bytes(b"\x7fELF and no more")
    with pytest.raises(ConfigError, match=r"text\.so: cannot be loaded: .*text\.so: file too short"):
        library_function(text)


def test_all_functions_that_are_missing_are_named_at_once(build: Build) -> None:
    with pytest.raises(
        ConfigError, match=r"faulty\.so: lacks aft_execute, aft_state_size \(required by aft\.h\)"
    ):
        library_function(build("-DLACKS"))


def test_a_library_without_any_of_them_is_refused(tmp_path: Path) -> None:
    source = tmp_path / "empty.c"
    source.write_text("int x;\n")
    with pytest.raises(ConfigError, match=f"lacks {', '.join(REQUIRED)} "):
        library_function(compiled(source))


@pytest.mark.parametrize(
    ("body", "declared"),
    [
        ("description->deterministic = 0;", Characteristics(False, EXACT)),
        ("description->state_access = AFT_NONE;", Characteristics(True, NONE)),
        (
            "description->state_access = AFT_APPROXIMATE; description->tolerance = 1e-9;",
            Characteristics(True, approximate(1e-9)),
        ),
    ],
)
def test_what_a_library_declares(build: Build, body: str, declared: Characteristics) -> None:
    assert library_function(build(f"-DDESCRIBE={body}"))().characteristics == declared


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("description->deterministic = 2;", "aft_describe: deterministic: found 2, 0 or 1 is allowed"),
        (
            "description->state_access = 3;",
            r"aft_describe: state_access: found 3, AFT_EXACT \(0\), AFT_APPROXIMATE",
        ),
        (
            "description->state_access = AFT_APPROXIMATE;",
            r"aft_describe: approximate\(0\): a tolerance is more than 0",
        ),
    ],
)
def test_a_declaration_that_is_not_allowed_is_refused(build: Build, body: str, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"faulty\.so: {message}"):
        library_function(build(f"-DDESCRIBE={body}"))


def test_without_state_access_the_state_is_empty(build: Build) -> None:
    one = library_function(build("-DDESCRIBE=description->state_access = AFT_NONE;"))()
    one.execute(b"S" + (5).to_bytes(8, "little"))
    assert one.capture() == b""
    one.restore(b"")
    with pytest.raises(PeerError, match="a state of 2 bytes, but there is no access to it"):
        one.restore(b"12")


# -- instances ------------------------------------------------------------------------------------


def test_a_library_with_one_state_has_one_instance_at_a_time(build: Build) -> None:
    make = library_function(build("-DONE_STATE"))
    one = make()
    one.execute(b"S" + (5).to_bytes(8, "little"))
    with pytest.raises(
        ConfigError, match=r"faulty\.so: aft_init gave the instance at 0x0, which is in use: .* one"
    ):
        make()
    del one
    assert make().capture() == b"", "a new one begins in the initial state"


def test_an_instance_is_freed_once_when_it_is_closed_or_collected(build: Build) -> None:
    path = build()
    make, ended = library_function(path), ctypes.CDLL(str(path)).ended_so_far
    one, other = make(), make()
    assert isinstance(one, LibraryFunction)
    one.close()
    one.close()
    assert ended() == 1
    uses: list[Callable[[], object]] = [
        partial(one.execute, b"e"),
        one.capture,
        partial(one.restore, b""),
        partial(one.acceptable, b"", b""),
    ]
    for use in uses:
        with pytest.raises(RuntimeError, match=r"faulty\.so: this instance is closed"):
            use()
    gc.disable()  # as in a node: there may be no cycle
    try:
        del other
        assert ended() == 2
    finally:
        gc.enable()


def test_init_that_fails_is_a_fault(build: Build) -> None:
    with pytest.raises(LibraryFailedError, match=r"faulty\.so: aft_init returned 1, AFT_OK \(0\) is allowed"):
        library_function(build("-DINIT_CODE=1"))()


# -- calls ----------------------------------------------------------------------------------------


def test_a_request_and_a_reply_may_have_any_bytes_and_the_whole_length(function: Application) -> None:
    request = b"e\0" + bytes(range(256)) * 200
    assert function.execute(request) == request
    assert function.execute(b"m") == b"m" * REPLY_BYTES_MAX


def test_what_a_reply_does_not_write_is_zero(function: Application) -> None:
    """Not what was there before, or replicas would differ."""
    assert function.execute(b"eeee") == b"eeee"
    assert function.execute(b"u") == bytes(4)


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        (b"w", "aft_execute wrote more than the 61440 bytes that it was given"),
        (b"s", r"aft_execute: \*reply_size is 61441, at most 61440 is allowed"),
        (b"n", r"aft_execute: \*reply_size was not set, at most 61440 is allowed"),
        (b"f", r"aft_execute returned -7, AFT_OK \(0\) or AFT_REFUSED \(1\) is allowed"),
    ],
)
def test_an_execution_that_breaks_the_contract_is_a_fault(
    function: Application, request_: bytes, message: str
) -> None:
    with pytest.raises(LibraryFailedError, match=rf"faulty\.so: {message}"):
        function.execute(request_)


def test_a_refused_request_is_no_fault(function: Application) -> None:
    with pytest.raises(PeerError, match="refuses the request of 1 bytes"):
        function.execute(b"r")
    with pytest.raises(PeerError, match="refuses the request of 0 bytes"):
        function.execute(b"")
    assert function.execute(b"e") == b"e"


def test_the_size_of_the_state_may_change(function: Application) -> None:
    function.execute(b"Vx")
    for size in (0, 3, 100_000, 1):
        function.execute(b"S" + size.to_bytes(8, "little"))
        assert function.capture() == b"x" * size


@pytest.mark.parametrize("size", [-1, -(2**63), STATE_BYTES_MAX + 1, 2**63 - 1])
def test_a_size_of_the_state_that_is_not_allowed_is_a_fault(function: Application, size: int) -> None:
    function.execute(b"S" + size.to_bytes(8, "little", signed=True))
    with pytest.raises(
        LibraryFailedError, match=f"aft_state_size returned {size}, 0 to {STATE_BYTES_MAX} is allowed"
    ):
        function.capture()


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        (b"C\x01", r"aft_capture returned 1, AFT_OK \(0\) is allowed"),
        (b"T", "aft_capture wrote more than the 0 bytes that it was given"),
    ],
)
def test_a_capture_that_breaks_the_contract_is_a_fault(
    function: Application, request_: bytes, message: str
) -> None:
    function.execute(request_)
    with pytest.raises(LibraryFailedError, match=message):
        function.capture()


def test_a_restore_is_refused_or_a_fault(function: Application) -> None:
    function.execute(b"R\x01")
    with pytest.raises(PeerError, match="refuses the state of 4 bytes"):
        function.restore(b"abcd")
    function.execute(b"R\x02")
    with pytest.raises(LibraryFailedError, match=r"aft_restore returned 2, AFT_OK \(0\) or AFT_REFUSED"):
        function.restore(b"abcd")


def test_the_executable_assertion(function: Application) -> None:
    assert function.acceptable(b"same", b"same") and not function.acceptable(b"same", b"other")
    with pytest.raises(LibraryFailedError, match="aft_acceptable returned 2, 0 or 1 is allowed"):
        function.acceptable(b"?", b"?")


def test_a_crash_ends_the_process_that_hosts_it(build: Build) -> None:
    code = (
        "import pathlib, sys; from aftbed.functions.library import library_function;"
        "library_function(pathlib.Path(sys.argv[1]))().execute(b'X')"
    )
    done = subprocess.run([sys.executable, "-c", code, str(build())], capture_output=True, check=False)
    assert done.returncode == -6, done
