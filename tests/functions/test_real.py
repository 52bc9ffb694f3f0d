"""Functions that others have written, installed by their packages: see `real/README.md`."""

import importlib.util
import json
import shutil
import subprocess
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import Final

import pytest
from liveruns import aftbed, home

from aftbed.functions.library import HEADER
from aftbed.functions.load import load_module
from aftbed.functions.request_file import GivenRequests
from aftbed.inject.model import parse
from aftbed.judge.verdict import Breach
from aftbed.runtime.sim.world import Setup
from aftbed.search.explore import attempt_own

__all__ = ["home"]

HERE = Path(__file__).parent / "real"
AEB, SAFETY_DRIVE = HERE / "aeb_decision.py", HERE / "safety_requests.py"
SUITED = ("pbr", "lfr", "pbr+tr", "lfr+tr")
CRASH: Final = ("--count", "60", "--inject", "crash primary at reply.sent nth 20")


@pytest.fixture(scope="module")
def aeb(request: pytest.FixtureRequest) -> ModuleType:
    pytest.importorskip("aeb.config", reason="mono-aeb is not installed")
    return load_module(str(AEB))


@pytest.fixture(scope="module")
def safety(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The libraries, by what they capture."""
    package = pytest.importorskip("opendbc", reason="opendbc is not installed")
    if (compiler := shutil.which("gcc")) is None:
        pytest.skip("gcc is missing, which compiles the safety code")
    folder, found = tmp_path_factory.mktemp("safety"), {}
    for name, options in (("whole", ()), ("listed", ("-DLISTED_ONLY",))):
        built = folder / f"{name}.so"
        words = [compiler, "-shared", "-fPIC", *options, "-I", Path(package.__path__[0]).parent]
        subprocess.run([*words, "-I", HEADER.parent, "-o", built, HERE / "safety.c"], check=True, timeout=60)
        found[name] = str(built)
    return found


def crashed(application: str, drive: Path, ftm: str, event: str, nth: int) -> tuple[Breach, ...]:
    """What breaks in 40 simulated requests if the primary crashes at the `nth` `event`."""
    requests = GivenRequests(f"{drive}:drive", tuple(islice(load_module(str(drive)).drive(0), 40)))
    fault = parse(f"crash primary at {event} nth {nth}")
    run, breaches = attempt_own(
        Setup(ftm, count=40, faults=(fault,), application=application, given=requests)
    )
    assert run is None or run.struck, "the fault has struck"
    return breaches


# -- mono-aeb -------------------------------------------------------------------------------------


def test_the_decision_chain_restores_exactly(aeb: ModuleType) -> None:
    """From each state on, a restored one makes the same replies and states."""
    requests = list(islice(aeb.drive(1), 50))
    serving, states, replies = aeb.AebDecision(), [], []
    for request in requests:
        replies.append(serving.execute(request))
        states.append(serving.capture())
    assert {reply[0] for reply in replies} >= {0, 1, 2}, "the drive leads to several levels"
    for number in range(0, 40, 3):
        other = aeb.AebDecision()
        other.restore(states[number])
        assert other.capture() == states[number]
        for later in range(number + 1, number + 10):
            assert other.execute(requests[later]) == replies[later]
            assert other.capture() == states[later]


@pytest.mark.simulation
@pytest.mark.parametrize("ftm", SUITED)
def test_the_decision_chain_survives_a_crash(aeb: ModuleType, ftm: str) -> None:
    assert crashed(f"{AEB}:AebDecision", AEB, ftm, "server.exit", 20) == ()


def test_a_part_of_the_state_that_was_forgotten_is_found(aeb: ModuleType) -> None:
    found = [crashed(f"{AEB}:WithoutFusion", AEB, "pbr", "reply.sent", nth) for nth in (9, 10, 19)]
    assert any(breach.promise == "G3" for breaches in found for breach in breaches), found


def test_rss_accepts_each_reply_of_the_chain_and_not_each_wrong_one(aeb: ModuleType) -> None:
    pytest.importorskip("ad_rss", reason="ad-rss is not installed")
    checked, requests = aeb.CheckedByRss(), list(islice(aeb.drive(0), 60))
    assert all(checked.acceptable(request, checked.execute(request)) for request in requests)
    brake = aeb.REPLY.pack(3, 1.0, 1.0)
    refused = [request for request in requests if not checked.acceptable(request, brake)]
    assert refused and not any(
        checked.acceptable(request, aeb.REPLY.pack(4, 1.0, 1.0)) for request in requests
    )


# -- opendbc --------------------------------------------------------------------------------------


@pytest.mark.simulation
@pytest.mark.parametrize("ftm", SUITED)
def test_the_safety_code_survives_a_crash(safety: dict[str, str], ftm: str) -> None:
    for nth in (5, 9, 21):
        assert crashed(safety["whole"], SAFETY_DRIVE, ftm, "server.exit", nth) == ()


def test_the_state_that_its_header_does_not_name_is_missed(safety: dict[str, str]) -> None:
    breaches = crashed(safety["listed"], SAFETY_DRIVE, "pbr", "reply.sent", 8)
    assert [breach.promise for breach in breaches] == ["G3"], breaches


# -- FMUs of gemseo-fmu ---------------------------------------------------------------------------

SPRINGS: Final = ("MassSpringSubSystem1", "x2", "x1")  # FMI 2, OpenModelica 1.21; an input and an output
DAMPER: Final = ("Mass_Damper", "f", "y")  # FMI 2, OpenModelica 1.19
PYTHON: Final = ("FMU3Model", "input", "output")  # FMI 3, PythonFMU3 0.2
STEPS: Final = "".join(f"{number % 7 / 4}\n" for number in range(60))


@pytest.fixture
def model(tmp_path: Path) -> Callable[..., tuple[str, ...]]:
    """The options that name a model, with what its map declares beside its ports."""
    found = importlib.util.find_spec("gemseo_fmu")  # not imported: it asks for what is not needed here
    if found is None or found.origin is None:
        pytest.skip("gemseo-fmu is not installed")
    models = Path(found.origin).parent / "problems" / "fmu_files" / "linux"

    def options(which: tuple[str, str, str], declared: str = "{}") -> tuple[str, ...]:
        name, given, told = which
        ports = [
            f"characteristics: {declared}",
            "step_s: 0.01",
            f"request: [{{type: f64, variable: {given}}}]",
            f"reply: [{{type: f64, variable: {told}}}]",
        ]
        (tmp_path / "ports.yaml").write_text("\n".join(ports))
        (tmp_path / "steps.csv").write_text(f"{given}:f64\n{STEPS}")
        app = f"{models / name}.fmu:{tmp_path / 'ports.yaml'}"
        return (app, "--requests", str(tmp_path / "steps.csv"))

    return options


@pytest.mark.process
@pytest.mark.parametrize(
    ("which", "declared", "access"),
    [
        (SPRINGS, "{}", "none"),
        (SPRINGS, "{state_access: exact}", "exact"),  # it serialises its state, and says that it cannot
        (PYTHON, "{}", "none"),
    ],
)
def test_the_state_access_of_a_model_is_measured(
    model: Callable[..., tuple[str, ...]], which: tuple[str, str, str], declared: str, access: str
) -> None:
    done = aftbed("app", "check", *model(which, declared), "--json")
    assert (done.code, done.err) == (0, ""), done.out + done.err
    measured = json.loads(done.out)["measured"]
    assert (measured["deterministic"], measured["state_access"]) == (True, access)


@pytest.mark.process
def test_a_model_without_the_state_access_that_its_map_declares_is_refused(
    model: Callable[..., tuple[str, ...]],
) -> None:
    done = aftbed("app", "check", *model(DAMPER, "{state_access: exact}"))
    assert done.code == 2 and "state_access: found exact, allowed is none" in done.err, done.err


@pytest.mark.process
@pytest.mark.parametrize(
    ("which", "declared", "ftm"),
    [
        (SPRINGS, "{state_access: exact}", "pbr+tr"),
        (SPRINGS, "{state_access: {approximate: 1.0e-6}}", "pbr"),
        (DAMPER, "{}", "lfr"),
        (PYTHON, "{}", "lfr"),
    ],
)
def test_a_model_survives_a_crash_in_a_real_run(
    model: Callable[..., tuple[str, ...]], which: tuple[str, str, str], declared: str, ftm: str
) -> None:
    done = aftbed("run", "--ftm", ftm, "--app", *model(which, declared), *CRASH)
    assert done.code == 0 and "60 sent, 60 answered, 0 lost" in done.out, done.out + done.err
    assert "failover   to epoch 2" in done.out and "0 wrong" in done.out


# -- real runs ------------------------------------------------------------------------------------


@pytest.mark.process
def test_the_decision_chain_survives_a_crash_in_a_real_run(aeb: ModuleType) -> None:
    done = aftbed("run", "--app", f"{AEB}:AebDecision", "--requests", f"{AEB}:drive", *CRASH)
    assert done.code == 0 and "60 sent, 60 answered, 0 lost" in done.out, done.out + done.err
    assert "failover   to epoch 2" in done.out and "note" not in done.err


@pytest.mark.process
def test_the_safety_code_survives_a_crash_in_a_real_run(safety: dict[str, str]) -> None:
    drive = ("--requests", f"{SAFETY_DRIVE}:drive")
    done = aftbed("run", "--app", safety["whole"], *drive, *CRASH)
    assert done.code == 0 and "60 sent, 60 answered, 0 lost" in done.out, done.out + done.err
    assert "failover   to epoch 2" in done.out and "note" not in done.err
