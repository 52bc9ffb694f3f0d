"""A campaign file: what is wrong with it is said with file, line and key, before anything runs."""

import re
from pathlib import Path
from typing import Final

import msgspec
import pytest
from campaigns import CRASHES, planned, written

from aftbed.campaign.plan import plan
from aftbed.campaign.spec import Spec, read_spec, shipped
from aftbed.cli import campaign as command
from aftbed.core.errors import ConfigError


def refusal(folder: Path, text: str) -> str:
    with pytest.raises(ConfigError) as refused:
        command.planned(command.CampaignArguments(name=str(written(folder, text))))
    return str(refused.value)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("seed: 3", "sed: 3", r"try.yaml: line 3, column 1: unknown key 'sed'; did you mean 'seed'\?"),
        (
            "seed: 3",
            'verifies: [SG-1, "SG 2"]',
            r"verifies\[1\]: found 'SG 2', allowed is an identifier such as SG-1 or FSR-3.2: a letter or a",
        ),
        ("seed: 3", 'verifies: ["SG\\x01"]', r"verifies\[0\]: found 'SG\\x01', allowed is an identifier"),
        (
            "seed: 3",
            "sometimes: [fail over]",
            r"sometimes\[\d\]: unknown name 'fail over'; did you mean 'failover'",
        ),
        (
            "seed: 3",
            "sometimes: [failover, fallback of the brakes]",
            r"sometimes: fallback of the brakes: no experiment has a car: add system.scenario",
        ),
        ("seed: 3", "verifies: [SG-1, SG-1]", r"verifies\[1\]: SG-1 stands twice"),
        ("seed: 3", "seed: -1", r"line 3, column \d+: seed: found -1, allowed is a whole number at least 0"),
        (
            "requests: 30",
            "requests: 30 Hz",
            r"line 4, column \d+: system.requests: found '30 Hz', allowed",
        ),
        (
            "runtime: sim",
            "runtime: ros",
            r"line 4, column \d+: system.runtime: found 'ros', allowed",
        ),
        ("[pbr, lfr, none]", "[pbr, lfx]", r"mechanisms\[\d\]: unknown name 'lfx'; did you mean 'lfr'"),
        ("[pbr, lfr, none]", "[]", r"line 5, column \d+: mechanisms: found \[\], allowed is a list"),
        (
            "crash primary at {event} nth {nth}",
            "bitflip memory at {event} nth {nth}",
            "under system.runtime sim",
        ),
        ("{event}", "{evnt}", r"'evnt'.* stands neither in matrix nor in draw"),
        (
            "server.exit",
            "server.exot",
            r"'crash' under pbr: unknown event 'server.exot'; did you mean 'server.exit'",
        ),
        (
            "crash primary",
            "crash primry",
            r"'crash' under pbr: unknown target 'primry'; did you mean 'primary'",
        ),
        ("[server.exit, reply.sent]", "[]", r"faults\[0\].matrix.event: it is empty"),
        ("[1, 25]", "[25, 1]", r"faults\[0\].draw.nth: found \[25, 1\], allowed is \[lowest, highest\]"),
        ("[1, 25]", "[1, 25]}\n  bits: {", r"faults\[0\]: unknown key 'bits'"),
        (
            "[tolerated]",
            "[tolerable]",
            r"faults\[0\].expect.\*\[0\]: unknown name 'tolerable'; did you mean 'tolerated'",
        ),
        ("name: nothing", "name: crash", r"faults\[1\].name: 'crash' stands twice"),
        (
            "stop: {experiments: 4}",
            "stop: {experiments: 0}",
            r"stop.experiments: found 0, allowed is a whole",
        ),
        (
            "stop: {experiments: 4}",
            "gates: [{metric: sdcc, max: 0.1}]",
            r"gates\[0\].metric: unknown metric 'sdcc'; did you mean 'sdc'",
        ),
        ("stop: {experiments: 4}", "gates: [{metric: sdc}]", r"gates\[0\]: either max or min"),
        (
            "stop: {experiments: 4}",
            "leave_out: [pbr · crsh]",
            r"leave_out\[0\]: unknown stratum 'pbr · crsh'; did you mean 'pbr · crash'",
        ),
        ("stop: {experiments: 4}", "leave_out: ['*']", r"leave_out: it leaves no stratum in"),
        ("campaign: try", "campaign: [", r"try.yaml: line \d+, column \d+: "),
        ("seed: 3", "seed: 3\nseed: 4", r"line 4, column \d+: key 'seed' stands twice"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in CRASHES
    found = refusal(tmp_path, CRASHES.replace(old, new))
    assert re.search(said, found), found
    assert found.startswith(str(tmp_path / "try.yaml"))


def test_a_campaign_that_does_not_exist_is_named_with_those_that_do() -> None:
    with pytest.raises(ConfigError, match=r"unknown campaign 'crsh'; did you mean 'crash'"):
        read_spec("crsh")


@pytest.mark.parametrize("name", shipped())
def test_a_shipped_campaign_can_be_run(name: str) -> None:
    """Every experiment of it is checked against the graph that it will find."""
    spec = read_spec(name)
    assert spec.campaign == name and spec.about
    assert plan(spec).size > 0


def test_requirements_are_those_of_the_campaign_and_of_its_scenario(tmp_path: Path) -> None:
    scenario = tmp_path / "road.yaml"
    scenario.write_text(
        "{description: empty, duration_s: 1, ego: {speed_kmh: 50}, expect: {outcome: no_braking},"
        " verifies: [SG-2, SG-1]}"
    )
    text = CRASHES.replace("system: {", f"verifies: [SG-1, FSR-3.2]\nsystem: {{scenario: {scenario}, ")
    assert planned(tmp_path, text).spec.verifies == ("SG-1", "FSR-3.2", "SG-2")


SCENARIO: Final = "{description: empty, duration_s: 1, ego: {speed_kmh: 50}, expect: {outcome: no_braking}}"


def test_files_are_looked_up_beside_the_campaign_and_then_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    beside, here = tmp_path / "beside", tmp_path / "here"
    beside.mkdir()
    here.mkdir()
    monkeypatch.chdir(here)
    driven = CRASHES.replace("system: {", "system: {scenario: roads/road.yaml, ")
    asked = CRASHES.replace("system: {", "system: {request_file: sent.csv, ")
    for text, key, name in (
        (driven, "scenario", "roads/road.yaml"),
        (asked, "request_file", "sent.csv"),
        (CRASHES.replace("system: {", "system: {app: my.py:Sum, "), "app", "my.py"),
    ):
        found = refusal(beside, text)
        where = rf"try.yaml: line 4, column \d+: system.{key}: .*/beside/{name}"
        told = f"{where}: no such file, beside the campaign file or in {here}$"
        assert re.search(told, found), found
    for folder in (here, beside):  # what is beside the file comes first
        (folder / "roads").mkdir()
        (folder / "roads/road.yaml").write_text(SCENARIO)
        assert planned(beside, driven).spec.system.scenario == str(folder / "roads/road.yaml")


def test_the_schema_knows_every_key() -> None:
    """For editors: a key that the reader takes is in it, and no other is allowed."""
    definitions = msgspec.json.schema(Spec)["$defs"]
    assert set(definitions["Spec"]["properties"]) == set(Spec.__struct_fields__)
    assert all(d["additionalProperties"] is False for name, d in definitions.items() if "properties" in d)


def test_an_event_that_a_mechanism_never_emits_is_refused(tmp_path: Path) -> None:
    text = CRASHES.replace("server.exit", "checkpoint.sent")
    assert "'crash' under lfr: event 'checkpoint.sent' cannot trigger a fault" in refusal(tmp_path, text)
    only = text.replace("mechanisms: [pbr, lfr]\n  expect", "mechanisms: [pbr]\n  expect")
    assert planned(tmp_path, only).size == 16
