"""`aftbed adapt plan` and `adapt script`: a plan as it is shown, a script as it is read from a file."""

import json
from pathlib import Path

import msgspec
import pytest
import yaml
from playedrun import PlayedRun, Run

from aftbed.adapt.plan import plan
from aftbed.adapt.scriptfile import ScriptFile, mapping, script_from
from aftbed.cli.adaptview import WIDTH
from aftbed.core.script import Script, Stage, flat
from aftbed.ftm.compose import build

# -- a plan


def test_a_plan_as_a_person_reads_it(told: Run) -> None:
    lines = told("adapt", "plan", "pbr+tr", "--from", "pbr").splitlines()
    assert lines[0] == "pbr to pbr+tr: 10 of 22 bricks (placement process, recipe drained)"
    text = "\n".join(lines)
    assert "  removed   a/proceed b/proceed\n" in text
    assert "  rebound   a/before a/after a/server b/before b/after b/server\n" in text
    assert "  added     a/tr.protocol a/tr.before" in text and "  kept      client proxy" in text
    assert "  replaced" not in text
    assert "prepare, while the old one serves: 30 steps\n  stage    a/tr.protocol (inner.protocol)\n" in text
    assert "  bind     a/before.bfr2prd -> a/tr.protocol.pxy2pro\n" in text
    assert "commit, while the client waits: 3 steps\n  suspend  a/protocol\n  together\n" in text
    assert "    resume   a/protocol\nfinish, when nothing has broken: 2 steps\n  retire   a/proceed\n" in text
    back = "way back, pbr+tr to pbr: 10 of 22 bricks (placement process, recipe drained)\n"
    assert f"{back}commit, while the client waits: 3 steps\n  suspend  a/protocol\n" in text
    assert max(len(line) for line in lines if line.startswith("  ")) <= WIDTH


def test_a_plan_names_what_is_staged_and_how(told: Run) -> None:
    text = told("adapt", "plan", "lfr", "--from", "pbr", "--placement", "replica")
    assert "  stage    a: a/protocol (protocol), a/before (lfr.before)" in text and ", held\n" in text
    paper = told("adapt", "plan", "lfr", "--from", "pbr", "--recipe", "paper")
    assert "  freeze   a/protocol\n" in paper and "recipe paper" in paper


@pytest.mark.parametrize("arguments", [(), ("--recipe", "paper"), ("--placement", "single")])
def test_a_plan_as_yaml_is_its_script(told: Run, arguments: tuple[str, ...]) -> None:
    text = told("adapt", "plan", "lfr+tr", "--from", "pbr", "--yaml", *arguments)
    script = script_from(msgspec.convert(yaml.safe_load(text), ScriptFile), "x")
    placement = "single" if "single" in arguments else "process"
    recipe = "paper" if "paper" in arguments else "drained"
    assert script == plan(build("pbr", placement), build("lfr+tr", placement), recipe).script


def test_a_plan_as_json(told: Run) -> None:
    found = json.loads(told("adapt", "plan", "pbr+tr", "--from", "pbr", "--json"))
    assert (found["from"], found["to"], found["placement"], found["recipe"]) == (
        "pbr",
        "pbr+tr",
        "process",
        "drained",
    )
    assert (found["bricks_changed"], found["bricks_total"]) == (10, 22)
    assert found["removed"] == ["a/proceed", "b/proceed"] and found["replaced"] == []
    there = plan(build("pbr", "process"), build("pbr+tr", "process"))
    assert found["script"] == mapping(there.script)
    assert found["way_back"]["script"] == mapping(plan(there.new, there.old).script)


def test_a_plan_from_what_runs(played: PlayedRun, told: Run) -> None:
    played.graph = build("lfr", "process").led_by("b")
    text = told("adapt", "plan", "lfr+tr")
    assert text.startswith("lfr to lfr+tr: 10 of 22 bricks")
    assert "  suspend  b/protocol\n" in text
    assert played.goals == [], "nothing is changed"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("lfr", "--from", "pbrr"), ("unknown FTM 'pbrr'", "did you mean 'pbr'")),
        (("pbrr", "--from", "pbr"), ("unknown FTM 'pbrr'",)),
        (("pbr", "--from", "pbr"), ("pbr is what runs already",)),
        (("pbr", "--from", "none"), ("neither starts nor ends",)),
        (("lfr", "--from", "pbr", "--placement", "proces"), ("unknown placement", "did you mean 'process'")),
        (("lfr", "--placement", "process"), ("--placement", "give --from EXPR too")),
        (("lfr", "--from", "pbr", "--yaml", "--json"), ("--yaml and --json", "one of them")),
        (("lfr", "--from", "pbr", "--recipe", "papr"), ("did you mean 'paper'",)),
    ],
)
def test_a_plan_that_cannot_be_made(refused: Run, arguments: tuple[str, ...], words: tuple[str, ...]) -> None:
    error = refused("adapt", "plan", *arguments)
    assert all(word in error for word in words), error


# -- a script


@pytest.fixture
def lfr(told: Run, tmp_path: Path) -> Path:
    """The file of a script from pbr to lfr."""
    path = tmp_path / "lfr.yaml"
    path.write_text(told("adapt", "plan", "lfr", "--from", "pbr", "--yaml"))
    return path


def test_a_script_is_asked_for_as_it_is_written(played: PlayedRun, told: Run, lfr: Path) -> None:
    told("adapt", "script", lfr)
    (goal,) = played.goals
    assert goal.script == plan(build("pbr", "process"), build("lfr", "process")).script
    assert goal.recipe == "drained"


def test_a_script_names_files_beside_itself(played: PlayedRun, told: Run, lfr: Path) -> None:
    (lfr.parent / "mine.py").write_text("")
    text = lfr.read_text()
    wanted = "{a/before: {kind: lfr.before, source: mine.py:Mine}}"
    assert "{a/before: lfr.before}" in text
    lfr.write_text(text.replace("{a/before: lfr.before}", wanted))
    told("adapt", "script", lfr)
    script = played.goals[0].script
    assert isinstance(script, Script)
    sources = {b.name: b.source for v in flat(script.prepare) if isinstance(v, Stage) for b in v.bricks}
    assert sources["a/before"] == f"{lfr.parent}/mine.py:Mine" and sources["a/after"] == ""


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("- suspend: a/protocol", "- suspend: a/protocool", ("commit[0]", "did you mean 'a/protocol'")),
        ("- suspend: a/protocol", "- suspnd: a/protocol", ("commit[0]", "did you mean 'suspend'")),
        ("- suspend: a/protocol\n", "", ("commit[3]: resumed, not suspended: a/protocol",)),
        ("  - resume: a/protocol\n", "", ("commit[0]: suspended, not resumed: a/protocol",)),
        ("finish:", "- destroy: a/proceed\nfinish:", ("commit[5]: killed with a request inside: a/proceed",)),
        ("finish:", "- kill: a\nfinish:", ("commit[5]: kill is Recovery's",)),
        ("- retire: a/before", "- retire: a/befor", ("finish[0]", "did you mean 'a/before'")),
        ("  - unbind: b/server.srv2aft\n", "", ("leads nowhere, and is not unbound: b/server.srv2aft",)),
        ("purpose:", "porpoise:", ("unknown key 'porpoise'", "did you mean 'purpose'")),
        ("ftm: lfr", "ftm: lfrr", ("ftm: unknown FTM 'lfrr'",)),
        ("lfr.before", "lfr.befor", ("prepare[0].stage.bricks.a/before", "did you mean 'lfr.before'")),
        ("source", "source", ()),
    ],
)
def test_a_script_with_a_mistake(
    played: PlayedRun, refused: Run, lfr: Path, old: str, new: str, words: tuple[str, ...]
) -> None:
    text = lfr.read_text()
    if old == new:
        text = text.replace("{a/before: lfr.before}", "{a/before: {kind: lfr.before, source: gone.py:Mine}}")
        words = ("gone.py", "no such file")
    assert old in text or old == new
    lfr.write_text(text.replace(old, new, 1))
    error = refused("adapt", "script", lfr)
    assert str(lfr) in error or old == new
    assert all(word in error for word in words), error
    assert played.goals == []


def test_a_script_with_many_mistakes_is_told_them_all(played: PlayedRun, refused: Run, lfr: Path) -> None:
    lfr.write_text(lfr.read_text().replace("drain:", "drane:").replace("align:", "allign:"))
    lines = refused("adapt", "script", lfr).splitlines()
    assert lines[0] == f"aftbed: error: {lfr}: 2 problems:"
    assert [line.strip().partition(":")[0] for line in lines[1:]] == ["commit[1]", "commit[2]"]


def test_a_script_for_another_graph_than_the_one_that_runs(
    played: PlayedRun, refused: Run, lfr: Path
) -> None:
    played.graph = build("pbr", "replica")
    assert "unknown node 'a/before'" in refused("adapt", "script", lfr)
    played.graph = build("pbr", "process").led_by("b")
    error = refused("adapt", "script", lfr)
    assert "commit[2]: changed while b/protocol lets requests in: align a/server -> b/server" in error


@pytest.mark.parametrize("content", ["", "[]", "5", "\0", "commit: [", "purpose: x"])
def test_a_file_that_is_no_script(played: PlayedRun, refused: Run, tmp_path: Path, content: str) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(content)
    assert str(path) in refused("adapt", "script", path)
    path.unlink()
    assert "No such file" in refused("adapt", "script", path)
