"""What a campaign leaves to the function: its mechanisms, the adaptations among them, the requests."""

import re
from pathlib import Path

import pytest
from campaigns import written
from certified import REQUESTS, STRANGERS, requests_in
from msgspec.structs import replace

from aftbed.campaign.experiment import Experiment, carry_out, setup_of
from aftbed.campaign.plan import plan, suited
from aftbed.campaign.smallest import smallest
from aftbed.campaign.spec import Spec, read_spec
from aftbed.cli import campaign as command
from aftbed.core.application import NONE, Characteristics, approximate
from aftbed.core.errors import ConfigError
from aftbed.functions.load import OWN_CODE
from aftbed.runtime.unix.trust import OWN_RUN

pytestmark = pytest.mark.simulation

SUITABLE = """
campaign: try
system: {requests: 30, runtime: sim, app: function.py:Counter, request_file: requests.csv}
mechanisms: [suitable]
adaptations:
- {name: steady, faults: ["crash*", wrong]}
- name: "to {mechanism}"
  adapt: to {mechanism} at request 9
  faults: [adapting]
  mechanisms: ["pbr*", lfr, tr, assert]
- {name: to itself, adapt: "update app to {app} at request 9", faults: [adapting]}
faults:
- name: crash
  fault: crash primary at server.exit nth 5
  mechanisms: ["pbr*", "lfr*"]
  expect: {pbr: [masked], "*tr": [latent], "*": [tolerated]}
- name: crash at a checkpoint
  fault: crash primary at {event} nth 5
  matrix: {event: [state.captured, checkpoint.sent]}
- name: crash both
  fault: [crash primary at server.exit nth 5, crash primary after 20ms]
- name: wrong
  fault: bitflip result at server.exit nth 5
- name: adapting
leave_out: ["lfr · steady · crash", "tr · steady · wrong"]
stop: {experiments: 1}
"""
MAKER = """
from pathlib import Path
from random import Random

def requests(seed):
    Path({sentinel!r}).touch()
    chance = Random(seed)
    while True:
        yield chance.randbytes(4)
"""

ALL = "none pbr lfr tr assert sup pbr+tr pbr+assert pbr+sup lfr+tr lfr+assert lfr+sup assert+tr"
APPROXIMATE = "none pbr lfr assert sup pbr+assert pbr+sup lfr+assert lfr+sup"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "function.py").write_text(STRANGERS.read_text())
    requests_in(tmp_path)
    return tmp_path


def read(folder: Path, text: str = SUITABLE) -> Spec:
    return read_spec(str(written(folder, text)))


def strata(spec: Spec) -> list[str]:
    return [stratum.name for stratum in plan(spec).strata]


@pytest.mark.parametrize(
    ("declared", "mechanisms"),
    [
        (Characteristics(), ALL),
        (Characteristics(deterministic=False), "none pbr assert sup pbr+assert pbr+sup"),
        (Characteristics(state_access=NONE), "none lfr assert sup lfr+assert lfr+sup"),
        (Characteristics(state_access=approximate(0.1)), APPROXIMATE),
    ],
    ids=str,
)
def test_the_mechanisms_are_those_that_suit(folder: Path, declared: Characteristics, mechanisms: str) -> None:
    found = suited(read(folder), declared)
    assert found.mechanisms == tuple(mechanisms.split())
    assert {name.split(" · ")[0] for name in strata(found)} <= set(found.mechanisms)


def test_an_entry_is_left_out_where_a_mechanism_does_not_know_its_words(folder: Path) -> None:
    names = strata(suited(read(folder), Characteristics()))
    assert [name for name in names if "checkpoint" in name] == [
        f"{ftm} · steady · crash at a checkpoint" for ftm in ("pbr", "pbr+tr", "pbr+assert", "pbr+sup")
    ]
    assert "none · steady · wrong" in names and "none · steady · crash" not in names


def test_words_that_no_mechanism_knows_are_refused(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"'wrong' under none: unknown event 'server.exot'"):
        plan(read(folder, SUITABLE.replace("result at server.exit", "result at server.exot")), OWN_RUN)


def test_a_mechanism_stands_for_each_other_one_that_can_be_reached(folder: Path) -> None:
    names = strata(suited(read(folder), Characteristics()))
    pairs = {(name.split()[0], name.split(" · ")[1].split()[1]) for name in names if " · to " in name}
    begun = {"pbr", "lfr", "tr", "assert", "pbr+tr", "pbr+assert", "pbr+sup"}
    ends = {*ALL.split()} - {"none"}
    assert {pair for pair in pairs if pair[1] != "itself"} == {
        (one, other) for one in begun for other in ends if one != other
    }
    assert "lfr · to itself · adapting" in names and "lfr · to lfr · adapting" not in names


def test_the_function_is_adapted_to_itself_by_another_name(folder: Path) -> None:
    spec = suited(read(folder), Characteristics())
    (entry,) = (entry for entry in spec.adaptations if entry.name == "to itself")
    assert entry.texts == (f"update app to {folder}/./function.py:Counter at request 9",)
    experiment = next(e for e in plan(spec).experiments() if e.stratum == "pbr · to itself · adapting")
    result = carry_out(experiment, lambda _: None)
    assert (result.outcome, result.adapted) == ("masked", ("done",)), result.reasons


def test_without_state_access_no_backup_is_expected_to_have_the_state(folder: Path) -> None:
    """The survivor of a failover stays alone; nothing becomes a duplex."""
    found = {s.name: s for s in plan(suited(read(folder), Characteristics(state_access=NONE))).strata}
    assert "lfr · steady · crash both" not in found
    assert found["lfr+assert · steady · crash"].expected == ("tolerated", "degraded")
    assert "lfr · to assert · adapting" in found and "assert · to lfr · adapting" not in found


def test_expectations_are_those_of_the_name_then_of_the_first_pattern(folder: Path) -> None:
    found = {s.name: s.expected for s in plan(suited(read(folder), Characteristics())).strata}
    assert found["pbr · steady · crash"] == ("masked",)
    assert found["pbr+tr · steady · crash"] == ("latent",)
    assert found["pbr+assert · steady · crash"] == ("tolerated",)


def test_what_leaves_nothing_out_is_no_mistake_where_the_mechanism_does_not_suit(folder: Path) -> None:
    spec = suited(read(folder), Characteristics(deterministic=False))
    assert spec.leave_out == () and plan(spec).size > 0


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[suitable]", "[suitable, pbr]", r"mechanisms: 'suitable' stands alone"),
        ("[suitable]", "[suitble]", r"mechanisms\[0\]: unknown name 'suitble'; did you mean 'suitable'"),
        ('["pbr*", "lfr*"]', '["pbx*"]', r"faults\[0\].mechanisms\[0\]: unknown name 'pbx\*'"),
        ('"*tr": [latent]', '"*tx": [latent]', r"faults\[0\].expect.\*tx: unknown name '\*tx'"),
        ("faults: [adapting]", "faults: [adaptin]", r"adaptations\[1\].faults\[0\]: unknown name 'adaptin'"),
        ('name: "to {mechanism}"', "name: other", r"adaptations\[1\].name: {mechanism} stands in adapt"),
        ("requests.csv", "none.csv", r"none.csv: no such file"),
        ("requests: 30,", "scenario: ccrs-50,", r"system.request_file: the car of system.scenario makes"),
    ],
)
def test_what_is_wrong_is_named(folder: Path, old: str, new: str, said: str) -> None:
    assert old in SUITABLE
    with pytest.raises(ConfigError, match=said):
        read(folder, SUITABLE.replace(old, new))


# -- requests -------------------------------------------------------------------------------------


def crash(folder: Path, **system: object) -> Experiment:
    spec = suited(read(folder), Characteristics())
    spec = replace(spec, system=replace(spec.system, **system))
    return next(e for e in plan(spec).experiments() if e.stratum == "pbr+tr · steady · crash")


def test_an_experiment_sends_the_requests_of_a_file_and_begins_anew_behind_the_last(folder: Path) -> None:
    experiment = crash(folder, requests=50)
    assert experiment.request_file == str(folder / "requests.csv")
    given = setup_of(experiment).given
    assert given is not None and len(given.requests) == REQUESTS.count("\n") - 1 == 40
    result = carry_out(experiment, lambda _: None)
    assert result.outcome == "tolerated", result.reasons
    assert result.requests is not None and (result.requests.sent, result.requests.wrong) == (50, 0)
    assert f"--requests {folder}/requests.csv --count 50" in experiment.command()
    real = replace(experiment, runtime="unix").command()
    assert f"--requests {folder}/requests.csv --count 50" in real and "--load" not in real


def test_a_function_makes_the_requests_of_each_experiment_by_its_seed(folder: Path) -> None:
    (folder / "maker.py").write_text(MAKER.format(sentinel=str(folder / "executed")))
    source = f"{folder / 'maker.py'}:requests"
    experiment = crash(folder, request_file=source)
    assert not (folder / "executed").exists(), "a plan executes nothing of it"
    with pytest.raises(ConfigError, match="no code from outside of the package is executed here"):
        setup_of(experiment)
    result = carry_out(experiment, lambda _: None)
    assert result.outcome == "tolerated" and (folder / "executed").exists()
    one, other = (setup_of(replace(experiment, seed=seed), OWN_CODE).given for seed in (1, 2))
    assert one is not None and other is not None and len(one.requests) == 30
    assert one.requests != other.requests
    (folder / "executed").unlink()
    with pytest.raises(ConfigError, match="no code from outside of the package is executed here"):
        smallest(replace(result, experiment=replace(experiment, app="")))
    assert not (folder / "executed").exists()


def test_a_request_file_is_changed_between_two_experiments(folder: Path) -> None:
    experiment = crash(folder)
    before = setup_of(experiment).given
    (folder / "requests.csv").write_text("n:u32\n7\n")
    after = setup_of(experiment).given
    assert before is not None and after is not None and after.requests == (b"\7\0\0\0",)


def test_the_digest_is_that_of_the_function_and_of_its_requests(folder: Path) -> None:
    spec = suited(read(folder), Characteristics())
    first = plan(spec)
    assert plan(spec) == first
    (folder / "requests.csv").write_text(REQUESTS + "1\n")
    longer = plan(spec)
    (folder / "function.py").write_text(STRANGERS.read_text() + "\n")
    changed = plan(spec)
    assert len({one.digest for one in (first, longer, changed)}) == 3
    assert not {e.id for e in first.experiments()} & {e.id for e in changed.experiments()}


def test_requests_that_cannot_be_read_are_named_before_anything_runs(folder: Path) -> None:
    spec = suited(read(folder), Characteristics())
    (folder / "requests.csv").write_text("n:u32\n-1\n")
    with pytest.raises(ConfigError, match=r"requests.csv: line 2: column n: found -1"):
        plan(spec)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"requests": "nowhere.csv"}, r"nowhere.csv: .*nowhere.csv: no such file"),
        ({"requests": "nowhere.py:make"}, r"nowhere.py: no such file"),
        ({"count": 0}, r"--count 0: 1 to 1000000 are allowed"),
        ({"app": "nowhere.py:It"}, r"nowhere.py: no such file"),
    ],
)
def test_options_override_the_file(folder: Path, given: dict[str, object], said: str) -> None:
    path = str(written(folder))
    with pytest.raises(ConfigError, match=said):
        command.planned(command.CampaignArguments(name=path, **given))  # type: ignore[arg-type]
    other = folder / "other.csv"
    other.write_text("n:u32\n1\n")
    found = command.planned(command.CampaignArguments(name=path, requests=str(other), count=31))
    assert (found.spec.system.request_file, found.spec.system.requests) == (str(other), 31)


def test_a_function_is_asked_only_if_it_is_trusted(folder: Path) -> None:
    """Its file is named by the campaign's file, which anybody may have written."""
    path = str(written(folder, SUITABLE))
    with pytest.raises(ConfigError, match=re.escape(f"{folder}/function.py:Counter is not trusted")):
        command.planned(command.CampaignArguments(name=path))
