"""Mechanisms of installed packages: found by entry points, used as ours are, and named where they break."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from packages import install, install_new

from aftbed.adapt.suitability import AMPLE, FaultModel, problems
from aftbed.cli import main
from aftbed.cli.completer import complete
from aftbed.core import installed
from aftbed.core.application import Characteristics
from aftbed.core.errors import ConfigError
from aftbed.core.messages import Goal, Scheduled
from aftbed.ftm import compose, registry
from aftbed.ftm.compose import EXPRESSIONS, build, duplex_expressions, expressions, parse
from aftbed.runtime.sim.world import Setup
from aftbed.search import explore


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A directory on the path. What is found there is forgotten behind the test."""
    folder = tmp_path / "site"
    tables = (registry.MECHANISMS, registry.BRICKS, registry.KINDS, registry.EMITTERS)
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    before = [dict(table) for table in tables]
    _forget()
    yield folder
    for table, content in zip(tables, before, strict=True):
        table.clear()
        table.update(content)  # type: ignore[arg-type]
    for name, module in list(sys.modules.items()):
        if str(folder) in str(getattr(module, "__file__", "")):
            del sys.modules[name]
    _forget()


def _forget() -> None:
    registry._unusable.clear()
    installed.entry_points.cache_clear()
    compose.load_installed.cache_clear()


@pytest.fixture
def limit(site: Path, tmp_path: Path) -> str:
    install_new(site, "limit", tmp_path / "project")
    return "limit"


def test_its_expressions_are_listed_behind_ours_and_within_them(limit: str) -> None:
    found = expressions()
    assert set(EXPRESSIONS) < set(found)
    assert {"limit", "pbr+limit", "lfr+limit", "limit+tr", "assert+limit"} <= set(found)
    assert {"pbr+limit", "lfr+limit"} == set(duplex_expressions()) - set(compose.DUPLEX_EXPRESSIONS)
    assert compose.load_installed() == ()


def test_a_name_is_found_without_the_others(limit: str, site: Path) -> None:
    install(site, "other", {"other": "other_module:X"}, other_module="raise AssertionError('imported')")
    assert parse("pbr+limit") == ("pbr", "limit")
    assert "other_module" not in sys.modules


def test_a_shell_completes_it_as_ours(limit: str, site: Path) -> None:
    install(site, "other", {"other": "other_module:X"}, other_module="raise ImportError('broken')")
    assert {"pbr", "limit", "other"} <= {word for word, _ in complete(["run", "--ftm", ""]).words}
    inside = [word for word, _ in complete(["run", "--ftm", "pbr+l"]).words]
    assert inside[0] == "pbr+limit" and "pbr+limit+tr" in inside
    assert complete(["run", "--ftm", "pbr+o"]).words == []


def test_for_our_mechanisms_no_package_is_looked_at(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "entry_points", lambda group: pytest.fail("packages were looked at"))
    for expression in EXPRESSIONS:
        build(expression, "process")
    assert compose.known_expressions() == EXPRESSIONS


def test_a_node_finds_its_kind_of_brick(limit: str) -> None:
    """It is given the kind, and no expression."""
    assert "limit" not in registry.MECHANISMS
    assert type(registry.make("limit.after", registry.Setting(1, 1, True, lambda: None))).__name__ == "After"  # type: ignore[arg-type, return-value]


def test_its_crashes_are_simulated_and_it_is_adapted_to(limit: str) -> None:
    selection = explore.selected("crash", ["pbr+limit"], ["replica"], requests=1)
    change = Scheduled(Goal(expression="lfr+limit"), 5)
    setups = [*list(selection.setups())[::9], Setup("pbr", count=20, adaptations=(change,))]
    assert len(setups) > 5 and [setup for setup in setups if explore.attempt(setup)[1]] == []


def test_its_declaration_says_whether_it_suits(limit: str) -> None:
    asked = FaultModel(crash=False, implausible=True)
    assert problems("pbr+limit", asked, Characteristics(), AMPLE) == []
    (alone,) = problems("limit", asked, Characteristics(), AMPLE)
    assert alone.startswith("limit detects implausible value faults and can only stop")


PORTS = """
from aftbed.ftm.chain import COMPUTE, PASS_BEFORE
from aftbed.ftm.declaration import BrickKind, Mechanism, Suitability
def made(name, after, **ports):
    kind = BrickKind(after, ("prd2aft", *ports.get("inputs", ())), ("aft2pro",), make=lambda setting: None)
    return Mechanism(name=name, before=PASS_BEFORE, proceed=COMPUTE, after=kind, suitability=Suitability())
loose = made("mine", "mine.after", inputs=("nobody",))
named = made("mine", "elsewhere.after")
other = made("other", "other.after")
ours = made("pbr", "pbr.after")
"""


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ("gone:X", "gone:X: ModuleNotFoundError: No module named 'gone'"),
        ("mine:X", "mine:X: AttributeError: module 'mine' has no attribute 'X'"),
        ("mine:made", "mine:made: found function <function made at"),
        ("mine:loose", "after:nobody is not bound"),
        ("mine:named", "mine:named: after: found a kind of brick 'elsewhere.after', allowed is mine.after"),
        ("mine:other", "mine:other: found a mechanism called other, allowed is the entry point's name"),
        ("quits:X", "quits:X: SystemExit: 4"),
        ("broken:X", "broken:X: SyntaxError: "),
    ],
)
def test_a_package_that_cannot_be_used_is_named_with_what_to_do(site: Path, place: str, reason: str) -> None:
    install(site, "my-package", {"mine": place}, mine=PORTS, quits="raise SystemExit(4)", broken="def")
    for _ in range(2):  # the second time without a second attempt
        with pytest.raises(ConfigError) as refused:
            build("pbr+mine", "process")
        assert str(refused.value).startswith("FTM mine of the package my-package 0.1.0: ")
        assert reason in str(refused.value)
        assert str(refused.value).endswith("; repair the package, or remove it: pip uninstall my-package")
    assert build("pbr", "process").ftm == "pbr"
    assert expressions() == EXPRESSIONS
    (why,) = compose.load_installed()
    assert reason in why


def test_where_all_are_listed_a_package_that_cannot_be_used_is_a_note(
    site: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(site, "my-package", {"mine": "gone:X"})
    monkeypatch.setattr(sys, "argv", ["aftbed", "ftm", "list"])
    with pytest.raises(SystemExit) as ended:
        main()
    shown = capsys.readouterr()
    assert ended.value.code == 0 and "pbr+assert" in shown.out and "mine" not in shown.out
    assert shown.err.startswith("aftbed: note: FTM mine of the package my-package 0.1.0: gone:X: ")


def test_the_name_of_one_of_ours_stays_ours(site: Path) -> None:
    install(site, "my-package", {"pbr": "mine:ours"}, mine=PORTS)
    assert expressions() == EXPRESSIONS
    (why,) = compose.load_installed()
    assert (
        "FTM pbr of the package my-package 0.1.0: aftbed has a mechanism pbr of its own, which is used" in why
    )


def test_a_name_that_two_packages_declare_is_refused(limit: str, site: Path) -> None:
    install(site, "my-package", {"limit": "mine:other"}, mine=PORTS)
    with pytest.raises(ConfigError, match=r"aftbed-limit 0\.1\.0 and my-package 0\.1\.0: both declare it"):
        parse("limit")


def test_an_event_that_all_bricks_of_a_part_emit_has_to_be_declared(site: Path) -> None:
    silent = "BrickKind('mine.before', ('pro2bfr',), ('bfr2prd',), make=None)"
    text = PORTS.replace("before=PASS_BEFORE", f"before={silent}").replace("elsewhere", "mine")
    install(site, "my-package", {"mine": "mine:named"}, mine=text)
    with pytest.raises(
        ConfigError, match=r"mine\.before must declare the event before\.exit, as .*pass\.before"
    ):
        parse("mine")


def test_nothing_is_taken_from_the_working_directory(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    install(here, "evil", {"evil": "evil_module:X"}, evil_module="raise AssertionError('executed')")
    monkeypatch.chdir(here)
    monkeypatch.syspath_prepend(str(here))  # as of an interpreter that was started there
    with pytest.raises(ConfigError, match="unknown FTM 'evil'"):
        parse("evil")


def test_unreadable_metadata_of_another_package_do_not_matter(limit: str, site: Path) -> None:
    install(site, "torn", {"x": "y"})
    torn = b"[aftbed.mechanisms]\nno sign of equality\n\xff"
    (site / "torn-0.1.0.dist-info" / "entry_points.txt").write_bytes(torn)
    assert parse("limit") == ("limit",)
