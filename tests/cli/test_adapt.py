"""`aftbed adapt`: what the run is asked for, what is shown, and what is refused before the run is asked.

The run that answers the commands is a `FakeRun`; real ones are in `tests/process/test_adapt_cli.py`.
"""

import json
from pathlib import Path

import msgspec
import pytest
import yaml
from fakerun import CAUTIOUS, CLOSED, OUTCOME, RANDOM, VARIANTS, Call, FakeRun, Output

from aftbed.adapt.planner import APPLICATION, plan, updated
from aftbed.adapt.script_file import ScriptFile, mapping, script_from
from aftbed.cli.adapt import WIDTH
from aftbed.core.messages import Goal
from aftbed.core.script import Script, Stage, flat
from aftbed.ftm.compose import build
from aftbed.runtime.unix import control_client

# -- what is asked for


@pytest.mark.parametrize(
    ("running", "arguments", "goal"),
    [
        ("pbr", ("to", "lfr+tr"), Goal(expression="lfr+tr")),
        ("pbr", ("switch", "lfr"), Goal(expression="lfr")),
        ("pbr", ("compose", "pbr+tr"), Goal(expression="pbr+tr")),
        ("pbr+tr", ("decompose",), Goal(expression="pbr")),
        ("pbr", ("to", "lfr", "--recipe", "paper"), Goal(expression="lfr", recipe="paper")),
        ("pbr+tr", ("decompose", "--recipe", "paper"), Goal(expression="pbr", recipe="paper")),
        (
            "pbr",
            ("update", "after", "--to", "some.module:After"),
            Goal(part="after", source="some.module:After"),
        ),
        ("pbr", ("update", "app", "--to", CAUTIOUS), Goal(part="app", source=CAUTIOUS)),
    ],
)
def test_each_command_asks_for_its_goal(
    fake: FakeRun, output: Output, running: str, arguments: tuple[str, ...], goal: Goal
) -> None:
    fake.graph = build(running, "process")
    assert output("adapt", *arguments).startswith("run abc123: pbr to lfr: done\n")
    assert fake.goals == [goal]
    assert fake.seconds == control_client.ADAPT_SECONDS_MAX, "an adaptation takes longer than other questions"


def test_a_file_is_sent_with_its_absolute_path(
    fake: FakeRun, output: Output, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run may have another working directory than the command."""
    (tmp_path / "mine.py").write_text("class Mine: pass\n")
    monkeypatch.chdir(tmp_path)
    output("adapt", "update", "proceed", "--to", "mine.py:Mine")
    assert fake.goals == [Goal(part="proceed", source=f"{tmp_path}/mine.py:Mine")]


# -- what is shown


def test_the_outcome_is_shown(fake: FakeRun, output: Output) -> None:
    assert output("adapt", "to", "lfr") == (
        "run abc123: pbr to lfr: done\n"
        "  prepare 12.25 ms, blackout 0.75 ms, total 118.50 ms; 4 of 16 bricks\n"
    )


def test_the_outcome_as_json_is_the_document_of_the_run(fake: FakeRun, output: Output) -> None:
    assert json.loads(output("adapt", "to", "lfr", "--json")) == OUTCOME


def test_a_rollback_is_exit_code_1(fake: FakeRun, call: Call) -> None:
    fake.outcome |= {"outcome": "rolled back", "reason": "b/after died"}
    for options in ((), ("--json",)):
        code, out, _ = call("adapt", "to", "lfr", *options)
        assert code == 1
        assert "rolled back" in out and "b/after died" in out


def test_a_refusal_of_the_run_is_exit_code_2(fake: FakeRun, refused: Output) -> None:
    fake.outcome |= {"outcome": "refused", "reason": "adaptation 2 (pbr to lfr) is under way"}
    assert "adaptation 2 (pbr to lfr) is under way" in refused("adapt", "to", "lfr")
    assert len(fake.goals) == 1


def test_a_refusal_without_a_reason_is_exit_code_2(fake: FakeRun, call: Call) -> None:
    fake.outcome |= {"outcome": "refused"}
    assert call("adapt", "to", "lfr")[0] == 2


def test_the_history_has_a_line_for_each_adaptation(fake: FakeRun, output: Output) -> None:
    assert output("adapt", "history").splitlines()[1:] == ["0 adaptations"]
    failed = {"number": 4, "outcome": "rolled back", "reason": "b/after died"}
    fake.history = [OUTCOME, OUTCOME | failed]
    head, first, second, count = output("adapt", "history").splitlines()
    assert head.split() == ["#", "ASKED", "PREPARE", "BLACKOUT", "TOTAL", "BRICKS", "RECIPE", "WHAT"]
    assert first == "  3    1.23 s   12.25 ms    0.75 ms  118.50 ms    4/16 drained pbr to lfr: done"
    assert second.endswith("pbr to lfr: rolled back: b/after died")
    assert count == "2 adaptations"
    assert json.loads(output("adapt", "history", "--json")) == {"adaptations": fake.history}


# -- what is refused before the run is asked


@pytest.mark.parametrize(
    ("running", "arguments", "words"),
    [
        (
            "pbr",
            ("compose", "lfr+tr"),
            ("lfr is not what runs (pbr): aftbed adapt to lfr+tr, or switch lfr first",),
        ),
        ("pbr", ("switch", "pbr+tr"), ("pbr is the outer mechanism already", "aftbed adapt compose pbr+tr")),
        ("pbr", ("decompose",), ("there is nothing inside pbr",)),
        ("pbr", ("to", "pbr"), ("pbr is what runs already",)),
        ("pbr", ("to", "pbrr"), ("unknown FTM 'pbrr'", "did you mean 'pbr'", "lfr")),
        ("pbr", ("to", "tr+pbr"), ("innermost (pbr+tr?)",)),
        ("pbr", ("to", "none"), ("an adaptation neither starts nor ends there",)),
        ("none", ("to", "pbr"), ("an adaptation neither starts nor ends there",)),
        ("pbr", ("to", "lfr", "--recipe", "papr"), ("unknown recipe 'papr'", "did you mean 'paper'")),
        (
            "pbr",
            ("update", "proced", "--to", "m:C"),
            ("unknown brick 'proced'", "did you mean 'proceed'", "app"),
        ),
        ("pbr", ("update", "tr.after", "--to", "m:C"), ("unknown brick 'tr.after'",)),
        ("pbr", ("update", "after", "--to", "m"), ("'m' names no class", "FILE.py:CLASS")),
        ("pbr", ("update", "after", "--to", "m:"), ("'m:' names no class",)),
        ("pbr", ("update", "after", "--to", ":C"), ("':C' names no class",)),
        ("pbr", ("update", "after", "--to", "m:C d"), ("'m:C d' names no class",)),
        ("pbr", ("update", "after", "--to", "gone.py:C"), ("gone.py:C", "no such file")),
        ("pbr", ("update", "app", "--to", "no.such.module:C"), ("C cannot be read: no module no",)),
        ("pbr", ("update", "app", "--to", f"{VARIANTS}:Calm"), ("has no class Calm", "Cautious")),
        (
            "pbr",
            ("update", "app", "--to", "pathlib:Path"),
            ("pathlib:Path is no protected function", "execute"),
        ),
    ],
)
def test_wrong_words_are_refused(
    fake: FakeRun, refused: Output, running: str, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    fake.graph = build(running, "process")
    error = refused("adapt", *arguments)
    assert all(word in error for word in words), error
    assert fake.goals == []


def test_the_recipe_of_the_paper_needs_placement_process(fake: FakeRun, refused: Output) -> None:
    fake.graph = build("pbr", "replica")
    assert "placement process, not replica" in refused("adapt", "to", "lfr", "--recipe", "paper")


@pytest.mark.parametrize(
    ("running", "function", "arguments", "reason", "instead"),
    [
        ("pbr", "", ("update", "app", "--to", CLOSED), "pbr needs state access", "lfr, lfr+assert, lfr+sup"),
        (
            "lfr",
            "",
            ("update", "app", "--to", RANDOM),
            "lfr needs a deterministic function",
            "pbr, pbr+assert, pbr+sup",
        ),
        ("lfr", CLOSED, ("to", "pbr"), "pbr needs state access", "lfr, lfr+assert, lfr+sup"),
        ("lfr", CLOSED, ("switch", "pbr+assert"), "pbr needs state access", "lfr, lfr+assert, lfr+sup"),
        ("lfr", CLOSED, ("compose", "lfr+tr"), "tr needs state access", "lfr, lfr+assert, lfr+sup"),
        ("pbr", RANDOM, ("to", "lfr"), "lfr needs a deterministic function", "pbr, pbr+assert, pbr+sup"),
    ],
)
def test_an_unsuitable_mechanism_is_refused_unless_forced(
    fake: FakeRun,
    refused: Output,
    call: Call,
    running: str,
    function: str,
    arguments: tuple[str, ...],
    reason: str,
    instead: str,
) -> None:
    fake.graph = build(running, "process", application=function)
    error = refused("adapt", *arguments)
    assert reason in error and f"(consistent: {instead})" in error and "--force" in error
    assert fake.goals == []
    code, _, notes = call("adapt", *arguments, "--force")
    assert code == 0 and len(fake.goals) == 1
    assert notes.startswith("aftbed: forced: ") and reason in notes


def test_removing_mechanisms_is_not_refused(fake: FakeRun, call: Call) -> None:
    """The smaller mechanism needs no more of the function than the larger one; neither does a new brick."""
    fake.graph = updated(build("pbr+tr", "process"), APPLICATION, CLOSED)
    assert call("adapt", "decompose")[::2] == (0, "")
    assert call("adapt", "update", "after", "--to", "m:C")[::2] == (0, "")
    assert len(fake.goals) == 2


def test_a_function_that_no_mechanism_suits(fake: FakeRun, refused: Output, tmp_path: Path) -> None:
    """It is not deterministic and has no state access."""
    (tmp_path / "neither.py").write_text(
        "from aftbed.core.application import NONE, Characteristics\n"
        f"from {VARIANTS} import WithoutStateAccess\n"
        "class Neither(WithoutStateAccess):\n"
        "    characteristics = Characteristics(deterministic=False, state_access=NONE)\n"
    )
    assert "(no consistent FTM)" in refused("adapt", "update", "app", "--to", tmp_path / "neither.py:Neither")


def test_a_function_without_characteristics_is_refused(
    fake: FakeRun, refused: Output, tmp_path: Path
) -> None:
    (tmp_path / "mute.py").write_text(
        f"from {VARIANTS} import Cautious\nclass Mute(Cautious):\n    characteristics = 'good'\n"
    )
    error = refused("adapt", "update", "app", "--to", tmp_path / "mute.py:Mute")
    assert "mute.py:Mute: characteristics: found 'good', allowed is Characteristics(...)" in error


def test_a_remark_on_a_suitable_mechanism_is_printed(fake: FakeRun, call: Call) -> None:
    fake.graph = build("lfr", "process")
    code, _, notes = call("adapt", "update", "app", "--to", CLOSED)
    assert code == 0
    assert notes == "aftbed: note: lfr without state access: after a failover the survivor stays alone\n"


@pytest.mark.parametrize(
    "arguments",
    [("to", "lfr"), ("decompose",), ("update", "after", "--to", "m:C"), ("history",), ("plan", "lfr")],
)
def test_no_run_is_alive(refused: Output, arguments: tuple[str, ...]) -> None:
    assert "no run is alive; start one with `aftbed run`" in refused("adapt", *arguments)
    assert "--run abcdef: no such run is alive" in refused("adapt", *arguments, "--run", "abcdef")


# -- a plan


def test_a_plan_as_text(output: Output) -> None:
    lines = output("adapt", "plan", "pbr+tr", "--from", "pbr").splitlines()
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


def test_a_plan_names_the_staged_bricks(output: Output) -> None:
    text = output("adapt", "plan", "lfr", "--from", "pbr", "--placement", "replica")
    assert "  stage    a: a/protocol (protocol), a/before (lfr.before)" in text and ", held\n" in text
    paper = output("adapt", "plan", "lfr", "--from", "pbr", "--recipe", "paper")
    assert "  freeze   a/protocol\n" in paper and "recipe paper" in paper


@pytest.mark.parametrize("arguments", [(), ("--recipe", "paper"), ("--placement", "single")])
def test_a_plan_as_yaml_is_its_script(output: Output, arguments: tuple[str, ...]) -> None:
    text = output("adapt", "plan", "lfr+tr", "--from", "pbr", "--yaml", *arguments)
    script = script_from(msgspec.convert(yaml.safe_load(text), ScriptFile), "x")
    placement = "single" if "single" in arguments else "process"
    recipe = "paper" if "paper" in arguments else "drained"
    assert script == plan(build("pbr", placement), build("lfr+tr", placement), recipe).script


def test_a_plan_as_json(output: Output) -> None:
    found = json.loads(output("adapt", "plan", "pbr+tr", "--from", "pbr", "--json"))
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


def test_a_plan_from_what_runs(fake: FakeRun, output: Output) -> None:
    fake.graph = build("lfr", "process").led_by("b")
    text = output("adapt", "plan", "lfr+tr")
    assert text.startswith("lfr to lfr+tr: 10 of 22 bricks")
    assert "  suspend  b/protocol\n" in text
    assert fake.goals == [], "nothing is changed"


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
def test_a_plan_that_cannot_be_made(
    refused: Output, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    error = refused("adapt", "plan", *arguments)
    assert all(word in error for word in words), error


# -- a script


@pytest.fixture
def lfr(output: Output, tmp_path: Path) -> Path:
    """The file of a script from pbr to lfr."""
    path = tmp_path / "lfr.yaml"
    path.write_text(output("adapt", "plan", "lfr", "--from", "pbr", "--yaml"))
    return path


def test_a_script_is_sent_as_it_is_written(fake: FakeRun, output: Output, lfr: Path) -> None:
    output("adapt", "script", lfr)
    (goal,) = fake.goals
    assert goal.script == plan(build("pbr", "process"), build("lfr", "process")).script
    assert goal.recipe == "drained"


def test_a_script_names_files_relative_to_itself(fake: FakeRun, output: Output, lfr: Path) -> None:
    (lfr.parent / "mine.py").write_text("")
    text = lfr.read_text()
    wanted = "{a/before: {kind: lfr.before, source: mine.py:Mine}}"
    assert "{a/before: lfr.before}" in text
    lfr.write_text(text.replace("{a/before: lfr.before}", wanted))
    output("adapt", "script", lfr)
    script = fake.goals[0].script
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
    fake: FakeRun, refused: Output, lfr: Path, old: str, new: str, words: tuple[str, ...]
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
    assert fake.goals == []


def test_all_mistakes_of_a_script_are_printed(fake: FakeRun, refused: Output, lfr: Path) -> None:
    lfr.write_text(lfr.read_text().replace("drain:", "drane:").replace("align:", "allign:"))
    lines = refused("adapt", "script", lfr).splitlines()
    assert lines[0] == f"aftbed: error: {lfr}: 2 problems:"
    places = [line.split(": ")[:2] for line in lines[1:]]
    assert places == [["  line 20, column 3", "commit[1]"], ["  line 21, column 3", "commit[2]"]]


def test_a_script_that_does_not_fit_the_running_graph(fake: FakeRun, refused: Output, lfr: Path) -> None:
    fake.graph = build("pbr", "replica")
    assert "unknown node 'a/before'" in refused("adapt", "script", lfr)
    fake.graph = build("pbr", "process").led_by("b")
    error = refused("adapt", "script", lfr)
    line = 1 + lfr.read_text().splitlines().index("- align: a/server -> b/server")
    place = f"line {line}, column 3: commit[2]"
    assert f"{place}: changed while b/protocol lets requests in: align a/server -> b/server" in error


@pytest.mark.parametrize("content", ["", "[]", "5", "\0", "commit: [", "purpose: x"])
def test_a_file_that_is_no_script(fake: FakeRun, refused: Output, tmp_path: Path, content: str) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(content)
    assert str(path) in refused("adapt", "script", path)
    path.unlink()
    assert "No such file" in refused("adapt", "script", path)
