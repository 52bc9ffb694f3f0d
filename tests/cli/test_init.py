"""`aftbed init` and `app new`: what they write, that it works as it is, and that nothing is overwritten."""

import json
import resource
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import PLUGIN, called
from fakerun import Output
from packages import install_new
from sampling import every

from aftbed.adapt.policy import PolicyFile, policy_from
from aftbed.adapt.script_check import refusals
from aftbed.adapt.script_file import ScriptFile, script_from
from aftbed.cli.init import FILES, KINDS, create, write_file
from aftbed.core.errors import ConfigError
from aftbed.core.messages import Goal, Scheduled
from aftbed.core.yaml_file import read_yaml
from aftbed.ftm.compose import build
from aftbed.runtime.sim.world import Setup
from aftbed.search.explore import attempt


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_new_project_is_listed_with_the_next_command(refused: Callable[..., str], here: Path) -> None:
    folder = create("heater", "so")
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    common = {"README.md", "requests.csv", "test_function.py", "campaign.yaml", ".github/workflows/test.yml"}
    assert files == common | {"function.c", "aft.h", "Makefile", ".aftbed/campaign.schema.json"}
    text = "".join(path.read_text() for path in folder.rglob("*") if path.is_file() and path.suffix != ".h")
    assert "heater" in text and "@APP@" not in text and "@NAME@" not in text
    assert len((folder / "README.md").read_text().splitlines()) <= 15
    assert "heater: is there already" in refused("app", "new", "heater")


@pytest.mark.parametrize(("kind", "needs"), [("class", "pytest"), ("fmu", "pytest FMPy")])
def test_what_a_project_needs_is_installed_by_its_ci_and_told(kind: str, needs: str, here: Path) -> None:
    """aftbed itself brings no FMPy."""
    folder = create("heater", kind)
    assert f'vars.AFTBED }}}}" {needs}\n' in (folder / ".github/workflows/test.yml").read_text()
    assert f"It needs (pip): aftbed {needs}.\n" in (folder / "README.md").read_text()


@pytest.mark.parametrize(
    "name", ["", "Heater", "../heater", "a/b", "-a", "1a", "a b", "a.b", "a" * 41, "h\u00e9ater", "a\n"]
)
def test_a_bad_name_is_refused(refused: Callable[..., str], here: Path, name: str) -> None:
    assert "is no name of a project: a small letter, then" in refused("app", "new", "--", name)
    assert list(here.iterdir()) == []


def test_an_unknown_kind_is_refused(refused: Callable[..., str], here: Path) -> None:
    assert "unknown kind 'clas'; did you mean 'class'?" in refused("app", "new", "a", "--kind", "clas")
    assert list(here.iterdir()) == []


def test_of_a_project_that_cannot_be_written_nothing_is_left(here: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(ConfigError, match=r"heater: cannot be written: File too large"):
            create("heater", "class")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert list(here.iterdir()) == []


@pytest.mark.parametrize("kind", FILES)
def test_a_file_is_named_with_the_next_command_and_never_overwritten(
    kind: str, here: Path, output: Output, refused: Output
) -> None:
    path = here / f"my-{kind}.yaml"
    told = output("init", kind).splitlines()
    assert told[0] == f"my-{kind}.yaml: written" and told[-1].startswith("next: aftbed ")
    assert path.name in told[-1]
    before = {one: one.read_bytes() for one in here.rglob("*") if one.is_file()}
    assert f"my-{kind}.yaml: is there already; choose another name, or --to FILE" in refused("init", kind)
    assert {one: one.read_bytes() for one in here.rglob("*") if one.is_file()} == before


def test_a_file_goes_where_it_is_wanted_with_its_schema_beside_it(here: Path, output: Output) -> None:
    (here / "a folder").mkdir()
    told = output("init", "map", "--to", "a folder/radar.yaml")
    assert {str(one.relative_to(here)) for one in here.rglob("*") if one.is_file()} == {
        "a folder/radar.yaml",
        "a folder/radar.log",
        "a folder/.aftbed/map.schema.json",
    }
    assert "--replay 'a folder/radar.log' --dbc ars408-like --map 'a folder/radar.yaml'" in told


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("scenario", "../up"), "'../up' is no name of a file: small letters, digits and '-' are allowed"),
        (("campaign", "A"), "'A' is no name of a file"),
        (("policy", "--to", "mine.txt"), "--to mine.txt: a file .yaml or .yml is allowed"),
        (
            ("policy", "--to", "gone/mine.yaml"),
            "gone/mine.yaml: cannot be written: No such file",
        ),
        (("mechanism", "Limit"), "'Limit' is no name of a mechanism: a small letter, then up to 19 small"),
        (("mechanism", "none"), "'none' is no name of a mechanism"),
        (("mechanism", "pbr"), "there is a mechanism pbr already; choose another name: aftbed ftm list"),
        (("mechanism", "--to", "gone/limit"), "gone/limit: cannot be made: No such file or directory"),
    ],
)
def test_what_cannot_be_written_is_refused_and_nothing_is_left(
    words: tuple[str, ...], reason: str, here: Path, refused: Output
) -> None:
    assert reason in refused("init", *words)
    assert list(here.iterdir()) == []


def test_what_was_written_is_told_in_json(here: Path, output: Output) -> None:
    told = json.loads(output("init", "map", "--json"))
    assert told["files"] == ["my-map.yaml", "my-map.log"] and told["next"].startswith("aftbed run --replay")
    assert all((here / one).is_file() for one in json.loads(output("init", "mechanism", "--json"))["files"])


def test_a_map_and_its_log_that_is_there_are_both_kept(here: Path, refused: Output) -> None:
    (here / "my-map.log").write_text("mine")
    assert "my-map.log: is there already" in refused("init", "map")
    assert [one.name for one in here.iterdir()] == ["my-map.log"]


def test_the_map_fits_its_log(here: Path, output: Output) -> None:
    write_file("map", "mine", None)
    assert "cycles  7: 7 with" in output(
        "map", "check", "mine.yaml", "--dbc", "ars408-like", "--log", "mine.log"
    )


def test_the_policy_and_the_script_are_accepted_and_the_script_is_carried_out(here: Path) -> None:
    write_file("policy", "mine", None)
    write_file("script", "by-hand", None)
    assert len(policy_from(read_yaml(Path("mine.yaml"), PolicyFile)).rules) == 2
    script = script_from(read_yaml(Path("by-hand.yaml"), ScriptFile), "by-hand.yaml")
    assert refusals(build("pbr", "process"), script) == []
    run, breaches = attempt(Setup("pbr", count=20, adaptations=(Scheduled(Goal(script=script), 5),)))
    assert breaches == () and run is not None


@pytest.mark.simulation
def test_the_scenario_and_the_campaign_pass(here: Path, output: Output) -> None:
    write_file("scenario", "drive", None)
    write_file("campaign", "crashes", None)
    assert "verdict: pass" in output("sim", "--scenario", "drive.yaml")
    assert "gate: pass" in output("campaign", "run", "crashes.yaml", "--out", "out", "--jobs", "1")


@pytest.mark.process
def test_the_package_of_a_mechanism_passes_its_own_tests(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = install_new(here / "site", "limit", here / "aftbed-limit")
    monkeypatch.setenv("PYTHONPATH", str(here / "site"))
    done = called(sys.executable, "-m", "pytest", "-q", *PLUGIN, "-W", "error", folder=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "4 passed" in done.stdout


@pytest.mark.process
@pytest.mark.parametrize("kind", every(3, ["so", "fmu", "stdio"]))
def test_a_new_project_passes_its_own_tests(kind: str, here: Path) -> None:
    """That of a class is tried by the test of docs/functions.md."""
    assert {"class", "so", "fmu", "stdio"} == {*KINDS}
    folder = create("heater", kind)
    if KINDS[kind].first:
        if shutil.which("gcc") is None or shutil.which("make") is None:
            pytest.skip("gcc or make is missing")
        made = called(*KINDS[kind].first.split(), folder=folder)
        assert made.returncode == 0, made.stderr
        assert "warning" not in made.stderr
    done = called(sys.executable, "-m", "pytest", "-q", *PLUGIN, "-W", "error", folder=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "8 passed" in done.stdout
    fewer = ("--experiments", "5") if kind == "stdio" else ()  # each starts the program several times
    words = ("-m", "aftbed", "campaign", "run", "campaign.yaml", *fewer, "--out", "out")
    done = called(sys.executable, *words, folder=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "gate: pass" in done.stdout


@pytest.mark.deep
def test_a_new_project_passes_on_real_processes(here: Path) -> None:
    folder = create("heater", "class")
    words = ("pytest", "-q", *PLUGIN, "--aftbed-runtime=unix", "-k", "corrected")
    done = called(sys.executable, "-m", *words, folder=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 passed" in done.stdout
