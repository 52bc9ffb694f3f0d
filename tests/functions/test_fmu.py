"""FMUs as protected functions: compiled from `fmus/` by gcc, and one that pythonfmu makes."""

import contextlib
import os
import shutil
import signal
import struct
import subprocess
import sys
import textwrap
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from string import Template
from typing import Final

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import aftbed
from aftbed.core.application import EXACT, NONE, Application, Field, approximate, reply_fields_of
from aftbed.core.errors import ConfigError, PeerError
from aftbed.functions import fmu
from aftbed.functions.fmu import FmuFailedError, fmu_function

SOURCES: Final = Path(__file__).parent / "fmus"
STATE: Final = {
    2: 'canGetAndSetFMUstate="true" canSerializeFMUstate="true"',
    3: 'canGetAndSetFMUState="true" canSerializeFMUState="true"',
}
BINARY: Final = {2: "binaries/linux64/integral.so", 3: "binaries/x86_64-linux/integral.so"}
NONE_DECLARED: Final = ""
FAULTS: Final = ("fails", "discards", "dies", "not a number", "infinite", "ends", "returns early")

PORTS: Final = """
step_s: 0.5
request:
- {type: f64, variable: u}
- {type: f32, variable: gain}
- {type: u16, skip: true}
- {type: u8, variable: fault}
- {type: bool, variable: active}
reply:
- {type: f64, variable: total, min: -100, max: 100}
- {type: u32, variable: count}
- {type: bool, variable: was_active}
"""
TICK: Final = "reply: [{type: f64, variable: total}]\nstep_s: 0.5\n"


def request(u: float = 0.0, gain: float = 1.0, fault: int = 0, active: int = 1) -> bytes:
    return struct.pack("<df2xBB", u, gain, fault, active)


def reply(total: float, count: int, active: int = 1) -> bytes:
    return struct.pack("<dIB", total, count, active)


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., bytes]:
    """The shared library of the model, by the version of FMI and what is defined; compiled once."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("gcc is missing, which compiles the FMUs")
    known: dict[tuple[int, tuple[str, ...]], bytes] = {}

    def compiled(version: int, *defined: str) -> bytes:
        if (version, defined) not in known:
            path = tmp_path_factory.mktemp("fmu") / "integral.so"
            words = [compiler, "-shared", "-fPIC", "-o", path, SOURCES / f"fmi{version}.c", "-lm"]
            subprocess.run([*words, *(f"-D{name}" for name in defined)], check=True, timeout=60)
            known[version, defined] = path.read_bytes()
        return known[version, defined]

    return compiled


Build = Callable[..., Path]
Make = Callable[..., Callable[[], Application]]


@pytest.fixture
def build(tmp_path: Path, library: Callable[..., bytes]) -> Build:
    """Write an FMU. `members` are added to it; one that is None is left out."""

    def built(
        version: int = 2,
        *defined: str,
        flags: str | None = None,
        members: Mapping[str | zipfile.ZipInfo, str | bytes | None] | None = None,
    ) -> Path:
        text = Template((SOURCES / f"fmi{version}.xml").read_text())
        whole: dict[str | zipfile.ZipInfo, str | bytes | None] = {
            "modelDescription.xml": text.substitute(flags=STATE[version] if flags is None else flags),
            BINARY[version]: library(version, *defined),
            **(members or {}),
        }
        path = tmp_path / "integral.fmu"
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in whole.items():
                if data is not None:
                    archive.writestr(name, data)
        return path

    return built


@pytest.fixture
def make(tmp_path: Path, build: Build) -> Make:
    def made(version: int = 2, *defined: str, ports: str = PORTS, flags: str | None = None) -> object:
        path = tmp_path / "ports.yaml"
        path.write_text(ports)
        return fmu_function(build(version, *defined, flags=flags), path)

    return made  # type: ignore[return-value]


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where FMUs are unpacked."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.delenv(fmu.RUN_VARIABLE, raising=False)
    return folder


def unpacked(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*/*") if path.is_dir())


both = pytest.mark.parametrize("version", [2, 3])


# -- requests -------------------------------------------------------------------------------------


@both
def test_a_request_is_a_step(make: Make, version: int) -> None:
    """The inputs are set, a parameter as well, then the model steps, then the outputs are read."""
    model = make(version)()
    assert model.execute(request(u=2.0)) == reply(1.0, 1)
    assert model.execute(request(u=2.0, gain=3.0)) == reply(4.0, 2)
    assert model.execute(request(u=-1.0, active=0)) == reply(3.5, 2, active=0)


@both
def test_values_before_the_first_step(make: Make, version: int) -> None:
    start = "start: {total: 7, u: 2.0, gain: 4, name: Ada}"
    assert make(version, ports=TICK + start)().execute(b"") == struct.pack("<d", 11.0)


@both
def test_the_step_is_the_difference_of_times(make: Make, version: int) -> None:
    ports = """
        step_s: 0.25
        request: [{type: f64, variable: u}, {type: u32, time: ms}]
        reply: [{type: f64, variable: total}]
        """
    make_model = make(version, ports=textwrap.dedent(ports))

    def total(time_ms: int) -> float:
        (found,) = struct.unpack("<d", model.execute(struct.pack("<dI", 1.0, time_ms)))
        return float(found)

    model = make_model()
    assert [total(5_000), total(5_100), total(7_100)] == pytest.approx([0.25, 0.35, 2.35])
    state = model.capture()
    with pytest.raises(PeerError, match=r"a step of 0 s, allowed is more than 0 and at most 3600 s"):
        total(7_100)
    with pytest.raises(PeerError, match=r"a step of -0\.1 s"):
        total(7_000)
    with pytest.raises(PeerError, match=r"a step of 3600\.1 s"):
        total(7_100 + 3_600_100)
    assert model.capture() == state
    model = make_model()
    model.restore(state)  # with the time of the last request
    assert total(7_600) == pytest.approx(2.85)


def test_the_step_is_a_field(make: Make) -> None:
    ports = """
        request: [{type: f64, variable: u}, {type: u16, step: us}]
        reply: [{type: f32, variable: total}]
        """
    model = make(ports=textwrap.dedent(ports))()
    assert model.execute(struct.pack("<dH", 1e6, 250)) == struct.pack("<f", 250.0)
    assert model.execute(struct.pack("<dH", 1e6, 50)) == struct.pack("<f", 300.0)
    with pytest.raises(PeerError, match="a step of 0 s"):
        model.execute(struct.pack("<dH", 1e6, 0))


@both
@pytest.mark.parametrize(
    ("bad", "why"),
    [
        (b"", "a request of 0 bytes, 16 are required"),
        (request() + b"\0", "a request of 17 bytes, 16 are required"),
        (request(u=float("nan")), "u: found nan, a finite number is required"),
        (request(u=float("-inf")), "u: found -inf, a finite number is required"),
        (request(active=2), "active: found 2, allowed are 0 and 1"),
    ],
)
def test_a_request_is_refused(make: Make, version: int, bad: bytes, why: str) -> None:
    model = make(version)()
    model.execute(request(u=1.0))
    before = model.capture()
    with pytest.raises(PeerError) as caught:
        model.execute(bad)
    assert str(caught.value) == why
    assert model.capture() == before
    assert model.execute(request(u=1.0)) == reply(1.0, 2)


def test_a_request_is_refused_whose_number_the_variable_cannot_hold(make: Make) -> None:
    ports = TICK + "request: [{type: i16, variable: fault}]\n"
    model = make(3, ports=ports)()
    for number in (-1, 256):
        with pytest.raises(PeerError, match=f"fault: {number} does not fit into UInt8"):
            model.execute(struct.pack("<h", number))
    model.execute(struct.pack("<h", 255))


# -- failures -------------------------------------------------------------------------------------


@both
@pytest.mark.parametrize(
    ("fault", "what"),
    [
        ("fails", r"fmi{version}DoStep failed with status 3 \(error\); its log: "),
        ("discards", r"fmi{version}DoStep failed with status 2 \(discard\); its log: "),
        ("dies", r"fmi{version}DoStep failed with status 4 \(fatal\); its log: "),
        ("not a number", "output total: found nan, a finite number is required"),
        ("infinite", "output total: found inf, a finite number is required"),
    ],
)
def test_a_failure_of_the_model_is_no_refusal(make: Make, version: int, fault: str, what: str) -> None:
    model = make(version)()
    model.execute(request())
    with pytest.raises(FmuFailedError, match=what.format(version=version)) as caught:
        model.execute(request(fault=1 + FAULTS.index(fault)))
    assert not isinstance(caught.value, PeerError)
    assert "integral.fmu: at 0.5 s, in a step of 0.5 s: " in str(caught.value)


def test_a_replica_whose_model_answers_nan_is_silent_and_the_other_one_answers(
    make: Make, tmp_path: Path
) -> None:
    """A flipped bit of one request, in one replica, is the fault that makes the model answer so."""
    make()  # writes both files
    nan, model = 1 + FAULTS.index("not a number"), str(tmp_path / "integral.fmu")
    assert nan == 1 << 2
    found = aftbed.run(
        model, [request(1.0)] * 20, inject=f"bitflip request bit {14 * 8 + 2} at server.enter nth 10"
    )
    assert (found.verdict, found.requests.answered, found.requests.wrong) == ("pass", 20, 0), str(found)
    (failure,) = found.failures
    assert failure.startswith("a/server: ") and "output total: found nan" in failure
    assert len(found.failovers) == 1 and found.faults[0].receipt.value == "activated"


def test_a_model_that_answers_nan_in_both_replicas_leaves_the_request_without_a_reply(
    make: Make, tmp_path: Path
) -> None:
    make()
    sent = [request(1.0)] * 9 + [request(fault=1 + FAULTS.index("not a number"))] + [request(1.0)] * 10
    found = aftbed.run(str(tmp_path / "integral.fmu"), sent)
    assert (found.verdict, found.requests.answered, found.requests.lost) == ("fail", 9, 1)
    assert [one.split(":")[0] for one in found.failures] == ["a/server", "b/server"]


def test_a_failure_comes_with_the_log_of_the_model(make: Make) -> None:
    """Formatted as the model wants it, and without what it said before."""
    models = [make(2)(), make(3)()]
    logs = ["fault 1 at 0 s, expected 0.5 s", "it does not go on"]
    for model, log in zip(models, logs, strict=True):
        with pytest.raises(FmuFailedError) as caught:
            model.execute(request(fault=1))
        assert str(caught.value).endswith(f"; its log: {log}")


@pytest.mark.parametrize(
    ("fault", "what"),
    [("ends", "the model ended the simulation"), ("returns early", "the model returned early")],
)
def test_a_model_of_fmi_3_may_stop_without_an_error(make: Make, fault: str, what: str) -> None:
    model = make(3)()
    with pytest.raises(FmuFailedError, match=f"{what} at 0.5 s"):
        model.execute(request(fault=1 + FAULTS.index(fault)))


def test_an_output_that_does_not_fit_is_a_failure(make: Make) -> None:
    ports = "step_s: 1\nrequest: [{type: f64, variable: u}]\nreply: [{type: f32, variable: total}]\n"
    with pytest.raises(FmuFailedError, match=r"output total: 1e\+300 does not fit into f32"):
        make(ports=ports)().execute(struct.pack("<d", 1e300))


# -- state ----------------------------------------------------------------------------------------


@both
def test_a_state_is_restored_in_another_instance(make: Make, version: int) -> None:
    """With the time: the model refuses a step that does not begin where the last one ended."""
    function = make(version)
    first, second = function(), function()
    assert first.characteristics.state_access == EXACT
    for _ in range(3):
        first.execute(request(u=2.0))
    state = first.capture()
    second.execute(request(u=50.0))
    second.restore(state)
    assert second.capture() == state
    assert second.execute(request(u=1.0)) == first.execute(request(u=1.0)) == reply(3.5, 4)
    second.restore(state)  # as a second trial does
    assert second.execute(request(u=1.0)) == reply(3.5, 4)


@both
def test_a_falsely_declared_state_shows_in_the_replies(make: Make, version: int) -> None:
    """This FMU declares all of its state, and forgets `count`."""
    function = make(version, "FORGETS")
    assert function().characteristics.state_access == EXACT
    first, second = function(), function()
    first.execute(request(u=2.0))
    second.restore(first.capture())
    assert first.execute(request()) == reply(1.0, 2)
    assert second.execute(request()) == reply(1.0, 1)


@both
def test_without_the_capability_there_is_no_state(make: Make, version: int) -> None:
    model = make(version, flags=NONE_DECLARED)()
    assert model.characteristics.state_access == NONE
    model.execute(request(u=2.0))
    assert model.capture() == b""
    model.restore(b"")
    with pytest.raises(PeerError, match="a state of 1 bytes, for a model without access to its state"):
        model.restore(b"x")
    assert model.execute(request(u=2.0)) == reply(2.0, 2)


@pytest.mark.parametrize("flag", STATE[2].split())
def test_half_of_the_capability_is_none(make: Make, flag: str) -> None:
    assert make(flags=flag)().characteristics.state_access == NONE


@pytest.mark.parametrize(
    ("flags", "said", "access"),
    [
        (STATE[2], "none", NONE),
        (STATE[2], "{approximate: 1e-9}", approximate(1e-9)),
        (NONE_DECLARED, "exact", EXACT),
    ],
)
def test_the_map_knows_better_than_the_fmu(make: Make, flags: str, said: str, access: object) -> None:
    ports = f"{PORTS}characteristics: {{deterministic: false, state_access: {said}}}\n"
    declared = make(flags=flags, ports=ports)().characteristics
    assert (declared.deterministic, declared.state_access) == (False, access)


def test_a_state_that_the_library_does_not_give_is_found_at_the_start(make: Make) -> None:
    function = make(2, "NO_STATE")
    with pytest.raises(ConfigError) as caught:
        function()
    assert "ports.yaml: characteristics.state_access: found exact, allowed is none: " in str(caught.value)
    assert "its state cannot be captured: fmi2GetFMUstate failed with status 3" in str(caught.value)


def test_a_state_has_a_limit(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fmu, "STATE_BYTES_MAX", 60)
    with pytest.raises(ConfigError, match="its state cannot be captured: 56 bytes, allowed are 39"):
        make()()


@pytest.mark.parametrize(
    ("mark", "time_s", "before"),
    [
        (b"FMU0", 1.0, b""),
        (b"FMU1", float("nan"), b""),
        (b"FMU1", float("inf"), b""),
        (b"FMU1", -1.0, b""),
        (b"FMU1", 1.0, b"1234"),  # there is no field with a time
    ],
)
def test_a_state_has_a_sound_header(make: Make, mark: bytes, time_s: float, before: bytes) -> None:
    model = make()()
    state = model.capture()
    with pytest.raises(PeerError, match="not a state of this model"):
        model.restore(struct.pack("<4sdB8s", mark, time_s, len(before), before) + state[21:])
    assert model.capture() == state


@pytest.fixture
def model(make: Make) -> Application:
    return make()()


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_what_is_no_state_is_refused(model: Application, data: st.DataObject) -> None:
    good = model.capture()
    header = st.binary(min_size=21, max_size=21).map(lambda found: found + good[21:])
    bad = data.draw(header | st.binary(max_size=200) | st.sampled_from([good[:-1], good + b"1", good]))
    try:
        model.restore(bad)
    except PeerError:
        assert model.capture() == good
    else:
        assert model.capture() == bad


# -- what it declares -----------------------------------------------------------------------------


def test_the_reply_has_a_layout(make: Make) -> None:
    fields = (Field("total", "f64", 0), Field("count", "u32", 8), Field("was_active", "bool", 12))
    function = make()
    assert reply_fields_of(function()) == fields
    assert getattr(function, "reply_fields") == fields  # noqa: B009 - known before there is an instance


def test_a_reply_is_acceptable_in_its_range(make: Make) -> None:
    model = make()()
    assert model.acceptable(request(), reply(100.0, 4))
    assert not model.acceptable(request(), reply(100.1, 4))
    assert not model.acceptable(request(), reply(float("nan"), 4))
    assert not model.acceptable(request(), reply(1.0, 4) + b"\0")
    assert make(ports=TICK)().acceptable(b"", b"anything")


# -- FMUs that are refused ------------------------------------------------------------------------


def refusal(model: Path, tmp_path: Path) -> str:
    ports = tmp_path / "ports.yaml"
    ports.write_text(PORTS)
    with pytest.raises(ConfigError) as caught:
        fmu_function(model, ports)
    assert str(caught.value).startswith(f"{model}: ")
    return str(caught.value).removeprefix(f"{model}: ")


def link(name: str) -> zipfile.ZipInfo:
    found = zipfile.ZipInfo(name)
    found.external_attr = 0o120777 << 16
    return found


@pytest.mark.parametrize(
    ("members", "why"),
    [
        ({"modelDescription.xml": None}, "no FMU: modelDescription.xml is missing"),
        ({"modelDescription.xml": "<a"}, "modelDescription.xml: not XML: "),
        (
            {"modelDescription.xml": '<fmiModelDescription fmiVersion="1.0"/>'},
            "modelDescription.xml: fmiVersion: found 1.0, allowed are 2.0 and 3.0",
        ),
        ({"modelDescription.xml": "<a/>"}, "modelDescription.xml: fmiVersion: found none, allowed are"),
        (
            {"modelDescription.xml": '<fmiModelDescription fmiVersion="2.0"/>'},
            "modelDescription.xml: cannot be read: Failed to validate modelDescription.xml",
        ),
        (
            {BINARY[2]: None, "binaries/win64/integral.dll": b"", "binaries/darwin64/integral.dylib": b""},
            "binaries/linux64/integral.so is missing (it has binaries for: darwin64, win64)",
        ),
        ({BINARY[2]: None}, "binaries/linux64/integral.so is missing (it has binaries for: none)"),
        *(
            ({name: b""}, f"found the member {name!r}, allowed are paths below the FMU, with slashes")
            for name in ("../evil", "/evil", "resources/../../evil", "a\\..\\evil", "a//evil", "./evil")
        ),
        ({link("resources/a"): "/etc"}, "found 'resources/a', a link or device, allowed are files and"),
    ],
)
def test_an_fmu_is_refused(
    build: Build, tmp_path: Path, members: Mapping[str | zipfile.ZipInfo, str | None], why: str
) -> None:
    assert refusal(build(members=members), tmp_path).startswith(why)


def test_an_fmu_for_model_exchange_is_refused(build: Build, tmp_path: Path) -> None:
    text = Template((SOURCES / "fmi2.xml").read_text()).substitute(flags="")
    text = text.replace("<CoSimulation ", "<ModelExchange ")
    text = text.replace('canHandleVariableCommunicationStepSize="true"', "")
    found = refusal(build(members={"modelDescription.xml": text}), tmp_path)
    assert found == "found an FMU for model exchange only, allowed is one for co-simulation"


@pytest.mark.filterwarnings("ignore:Duplicate name:UserWarning")
def test_a_member_that_stands_twice_is_refused(build: Build, tmp_path: Path) -> None:
    path = build()
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("modelDescription.xml", "<other/>")
    assert refusal(path, tmp_path) == "found the member 'modelDescription.xml' twice, allowed is once"


@pytest.mark.parametrize(
    ("limit", "why"),
    [
        ("MEMBERS_MAX", "found 2 members, allowed are 1"),
        ("UNPACKED_BYTES_MAX", "bytes when unpacked, allowed are 1"),
        ("ARCHIVE_BYTES_MAX", "bytes, allowed are 1"),
        ("DESCRIPTION_BYTES_MAX", "modelDescription.xml: found "),
    ],
)
def test_an_fmu_has_limits(
    build: Build, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, why: str
) -> None:
    monkeypatch.setattr(fmu, limit, 1)
    assert why in refusal(build(), tmp_path)


def test_what_is_no_archive_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.fmu"
    assert refusal(path, tmp_path) == "cannot be read: No such file or directory"
    path.write_bytes(b"no archive")
    assert refusal(path, tmp_path) == "found no zip archive, as an FMU is, or a broken one"
    path.unlink()
    os.mkfifo(path)
    assert refusal(path, tmp_path) == "cannot be read: not a regular file"


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cuts=st.lists(st.tuples(st.floats(0, 1), st.binary(max_size=8)), max_size=4), end=st.floats(0, 1))
@example(cuts=[], end=1.0)
def test_a_broken_fmu_is_refused_or_works(
    build: Build, tmp_path: Path, cuts: list[tuple[float, bytes]], end: float
) -> None:
    path = build(members={BINARY[2]: b"\x7fELF"})  # not loaded here
    data = bytearray(path.read_bytes())
    for place, text in cuts:
        at = int(place * len(data))
        data[at : at + len(text)] = text
    path.write_bytes(data[: int(end * len(data))] if end < 0.5 else data)
    ports = tmp_path / "ports.yaml"
    ports.write_text(TICK)
    with contextlib.suppress(ConfigError):
        fmu_function(path, ports)


def test_a_library_that_cannot_be_loaded_is_named(build: Build, tmp_path: Path) -> None:
    here = Path.cwd()
    ports = tmp_path / "ports.yaml"
    ports.write_text(TICK)
    function = fmu_function(build(members={BINARY[2]: b"\x7fELF"}), ports)
    with pytest.raises(ConfigError, match=r"fmu: it cannot be loaded: .*integral.so.*file too short"):
        function()
    assert Path.cwd() == here  # FMPy goes there to load it


def test_without_fmpy_the_extra_is_named(
    build: Build, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = build()
    fmu.import_fmpy.cache_clear()
    monkeypatch.setitem(sys.modules, "fmpy.fmi2", None)
    with pytest.raises(ConfigError, match=r'an FMU needs FMPy \(.*\): pip install "aftbed\[fmi\]"'):
        fmu_function(model, tmp_path / "ports.yaml")


# -- the copy on disk -----------------------------------------------------------------------------


def test_the_copy_is_private_and_removed_with_the_last_user(make: Make, temporary: Path) -> None:
    function = make()
    assert unpacked(temporary) == []
    first, second = function(), function()
    (folder,) = unpacked(temporary)
    assert folder.stat().st_mode & 0o777 == folder.parent.stat().st_mode & 0o777 == 0o700
    assert (folder / BINARY[2]).is_file()
    del function, first
    assert second.execute(request()) == reply(0.0, 1)
    del second
    assert unpacked(temporary) == []


def test_only_what_this_platform_needs_is_unpacked(build: Build, tmp_path: Path, temporary: Path) -> None:
    extra = dict.fromkeys(("sources/a.c", "documentation/index.html", "binaries/win64/integral.dll"), b"1")
    model = build(members={**extra, "resources/data.csv": b"1", "resources/empty/": b""})
    ports = tmp_path / "ports.yaml"
    ports.write_text(TICK)
    application = fmu_function(model, ports)()
    (folder,) = unpacked(temporary)
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert files == {"modelDescription.xml", BINARY[2], "resources/data.csv"}
    assert (folder / "resources" / "empty").is_dir()
    del application


def test_in_a_run_the_copy_is_in_its_directory(
    make: Make, tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    private = tmp_path / "run"
    private.mkdir()
    monkeypatch.setenv(fmu.RUN_VARIABLE, str(private))
    application = make()()
    assert len(unpacked(private)) == 1 and unpacked(temporary) == []
    del application


@contextlib.contextmanager
def child(work: Callable[[], object]) -> Iterator[int]:
    """A fork that has done `work`, and waits to be killed."""
    ready, done = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            kept = work()
            os.write(done, b"1")
            while kept:
                signal.pause()
        finally:
            os._exit(1)
    os.close(done)
    try:
        assert os.read(ready, 1) == b"1"
        yield pid
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(ready)


def test_what_a_killed_process_leaves_is_removed_by_the_next(make: Make, temporary: Path) -> None:
    with child(make()):
        (left,) = unpacked(temporary)
        make()()
        assert unpacked(temporary) == [left]  # it lives
    assert unpacked(temporary) == [left]
    application = make()()
    assert left not in unpacked(temporary) and len(unpacked(temporary)) == 1
    assert application.execute(request()) == reply(0.0, 1)


def test_a_child_does_not_remove_the_copy_of_its_parent(make: Make, temporary: Path) -> None:
    kept = [make()()]
    with child(lambda: kept.clear() or True):
        assert len(unpacked(temporary)) == 1
    assert kept[0].execute(request()) == reply(0.0, 1)


def test_a_folder_of_another_user_is_not_used(make: Make, temporary: Path) -> None:
    (temporary / f"aftbed-fmu-{os.getuid()}").mkdir(mode=0o755)
    function = make()
    with pytest.raises(ConfigError, match=r"must be a directory of this user alone \(mode 0700\)"):
        function()


def test_a_model_may_allow_one_instance_in_a_process(make: Make) -> None:
    """Each instance has a library of its own then: this one refuses a second one."""
    twice = make(2, "ONCE")
    kept = twice()
    with pytest.raises(ConfigError, match="it cannot be loaded: Failed to instantiate model"):
        twice()
    del kept
    function = make(2, "ONCE", flags=f'{STATE[2]} canBeInstantiatedOnlyOncePerProcess="true"')
    first, second = function(), function()
    assert first.execute(request()) == second.execute(request()) == reply(0.0, 1)


# -- in a process of its own ----------------------------------------------------------------------


def run_python(code: str, *arguments: object) -> str:
    words = [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)]
    path = str(Path(aftbed.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": path}
    environment.pop("OPENBLAS_NUM_THREADS", None)
    return subprocess.run(
        words, env=environment, check=True, timeout=60, stdout=subprocess.PIPE, text=True
    ).stdout


def test_an_import_of_fmpy_has_no_side_effects(build: Build, tmp_path: Path, temporary: Path) -> None:
    """No thread, no output, no plots; and at the end of the process its copy is removed."""
    ports = tmp_path / "ports.yaml"
    ports.write_text(PORTS)
    code = """
        import os, sys
        from pathlib import Path
        from aftbed.functions.fmu import fmu_function
        assert "fmpy" not in sys.modules
        before = dict(os.environ)
        kept = fmu_function(Path(sys.argv[1]), Path(sys.argv[2]))()
        assert dict(os.environ) == before
        assert len(os.listdir("/proc/self/task")) == 1
        print(*{"matplotlib", "plotly", "PySide6", "tkinter"} & set(sys.modules))
        """
    assert run_python(code, build(), ports) == "\n"
    assert unpacked(temporary) == []


def test_an_fmu_of_pythonfmu(tmp_path: Path) -> None:
    """It runs in this interpreter. It restores the variables that it registers, and forgets the others."""
    (tmp_path / "adder.py").write_text(
        textwrap.dedent("""
            from pythonfmu import Fmi2Causality, Fmi2Slave, Real

            class Adder(Fmi2Slave):
                def __init__(self, **kwargs):
                    super().__init__(**kwargs)
                    self.u = self.total = self.number = 0.0
                    self._hidden = 0
                    self.register_variable(Real("u", causality=Fmi2Causality.input))
                    self.register_variable(Real("total", causality=Fmi2Causality.output))
                    self.register_variable(Real("number", causality=Fmi2Causality.output))

                def do_step(self, current_time, step_size):
                    self._hidden += 1
                    self.total += self.u * step_size
                    self.number = float(self._hidden)
                    if self.u > 100:
                        raise ValueError("too much")
                    return True
            """)
    )
    words = [sys.executable, "-m", "pythonfmu", "build", "--handle-state", "--serialize-state"]
    subprocess.run([*words, "-f", "adder.py"], cwd=tmp_path, check=True, timeout=60)
    (tmp_path / "ports.yaml").write_text(
        "step_s: 0.5\n"
        "request: [{type: f64, variable: u}]\n"
        "reply: [{type: f64, variable: total}, {type: f64, variable: number}]\n"
    )
    code = """
        import sys
        from pathlib import Path
        from struct import pack, unpack
        from aftbed.functions.fmu import FmuFailedError, fmu_function
        function = fmu_function(Path(sys.argv[1]), Path(sys.argv[2]))
        first, second = function(), function()
        print(first.characteristics.state_access)
        print(*unpack("<2d", first.execute(pack("<d", 4.0))))
        second.restore(first.capture())
        print(*unpack("<2d", first.execute(pack("<d", 1.0))))
        print(*unpack("<2d", second.execute(pack("<d", 1.0))))
        try:
            first.execute(pack("<d", 101.0))
        except FmuFailedError as error:
            print("too much" in str(error), "fmi2DoStep failed" in str(error))
        """
    found = run_python(code, tmp_path / "Adder.fmu", tmp_path / "ports.yaml").split("\n")
    assert found == ["exact", "2.0 1.0", "2.5 2.0", "2.5 1.0", "True True", ""]
