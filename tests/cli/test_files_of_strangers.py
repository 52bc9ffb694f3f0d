"""Files that a stranger has made: the command that reads one executes nothing, and writes only its output.

Every file is in a folder of the stranger, which is the working directory too, and in which modules lie that
leave a sentinel when they are imported. What lies there, and beside it, is the same after each command.
"""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from fakerun import Call
from liveruns import called
from records import outcomes, whole
from sampling import sampled

from aftbed.campaign.ledger import NAME
from aftbed.campaign.ledger import read as read_ledger
from aftbed.core.events import Event
from aftbed.interop.openscenario import importer
from aftbed.report.bundle import SUMS, BundledFile, archive_of, entries, sha256
from aftbed.report.documents import HTML, JUNIT, MARKDOWN, SUMMARY
from aftbed.runtime.unix.trust import NOBODY

pytestmark = pytest.mark.simulation

INTEROP: Final = Path(importer.__file__).resolve().parents[3] / "tests" / "interop" / "xosc"
SENTINEL: Final = "EXECUTED"
EVIL_MODULES: Final = (
    "evil.py",
    "yaml.py",
    "aftbed.py",
    "multiprocessing.py",
    "evil_package/__init__.py",
    "record/evil.py",
)
EVIL: Final = "from pathlib import Path\nPath({sentinel!r}).touch()\nclass Evil: pass\n"
TAGS: Final = (  # what an unsafe loader of YAML would execute
    "!!python/object/apply:os.system ['touch {sentinel}']",
    "!!python/object/new:evil.Evil []",
    "!!python/module:evil",
    "!!python/name:evil.Evil",
    "!evil.Evil {{}}",
)
ESCAPE: Final = "\x1b]0;title\x07\x9b2J\u202e"
SCRIPT: Final = "<script>alert(1)</script>"
CAMPAIGN: Final = """
campaign: try
system: {requests: 20, runtime: sim}
mechanisms: [pbr]
faults:
- name: crash
  fault: crash primary at server.exit nth 5
stop: {experiments: 1}
"""


def contents(folder: Path) -> dict[str, str]:
    """Every name below `folder`, with the bytes of a file and the target of a link."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink():
            found[str(path)] = f"-> {path.readlink()}"
        else:
            found[str(path)] = path.read_bytes().hex() if path.is_file() else "directory"
    return found


class Stranger:
    """The folder of a stranger, beside a file of the user that must stay as it is."""

    def __init__(self, folder: Path, call: Call) -> None:
        self.root, self.folder, self.sentinel = folder, folder / "stranger", folder / SENTINEL
        self.folder.mkdir()
        self.out = folder / "out"
        self.out.mkdir()
        self.mine = folder / "mine.txt"
        self.mine.write_text("of the user")
        for name in EVIL_MODULES:
            self.file(name, EVIL.format(sentinel=str(self.sentinel)))
        self._call = call

    def file(self, name: str, text: str | bytes) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    def read_by(self, *words: str | Path, code: int) -> str:
        """What the command prints; it ends with `code`, and leaves all but `out` as it was."""
        before = contents(self.root)
        found, out, err = self._call(*words)
        assert found == code, (found, out, err)
        assert "Traceback" not in err
        if "--json" not in words:  # which is for programs
            assert not any(one in out + err for one in "\x1b\x9b\u202e\x07"), "the terminal is not spoken to"
        after = {name: it for name, it in contents(self.root).items() if not name.startswith(str(self.out))}
        assert after == {name: it for name, it in before.items() if not name.startswith(str(self.out))}
        assert not self.sentinel.exists()
        return out + err


@pytest.fixture
def stranger(tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> Stranger:
    found = Stranger(tmp_path, call)
    monkeypatch.chdir(found.folder)
    monkeypatch.syspath_prepend(str(found.folder))  # as `python -m aftbed` would have it
    return found


# -- YAML: scenario, map, campaign, policy, script, table --------------------------------------------


def yaml_readers(file: str) -> list[tuple[str, ...]]:
    replayed = ("run", "--replay", "log.log", "--dbc", "esr-like", "--map", file)
    return [
        ("scenario", "show", file),
        ("sim", "--scenario", file),
        ("run", "--scenario", file),
        replayed,
        ("campaign", "plan", file),
        ("campaign", "run", file),
        ("run", "--policy", file),
        ("adapt", "script", file),
        ("ftm", "list", "--table", file),
        ("map", "check", f"./{file}", "--dbc", "esr-like"),
    ]


@pytest.mark.parametrize("words", yaml_readers("file.yaml"), ids=lambda words: " ".join(words[:3]))
def test_yaml_is_data(stranger: Stranger, words: tuple[str, ...]) -> None:
    stranger.file("log.log", "(0000000001.000000) can0 130#00\n")
    for tag in TAGS:
        for text in (f"campaign: {tag}\n", f"{tag}\n", f"? {tag}\n: x\n"):
            stranger.file("file.yaml", text.format(sentinel=stranger.sentinel))
            shown = stranger.read_by(*words, code=2)
            assert "no tag (!), no <<" in shown or "no run is alive" in shown
    stranger.file(
        "file.yaml",
        "a: &a [x]\n"
        + "".join(
            f"{n}: &{n} [{', '.join(['*' + b] * 9)}]\n" for b, n in zip("abcdefghi", "bcdefghij", strict=True)
        ),
    )
    stranger.read_by(*words, code=2)
    (stranger.folder / "file.yaml").unlink()
    (stranger.folder / "file.yaml").symlink_to("/dev/zero")
    stranger.read_by(*words, code=2)


def test_a_campaign_file_is_planned_without_its_code(stranger: Stranger) -> None:
    update = '[update app to evil.py:Evil at request 3, "update after to evil_package:Evil at request 9"]'
    file = stranger.file("c.yaml", CAMPAIGN + f"adaptations:\n- {{name: {SCRIPT}, adapt: {update}}}\n")
    stranger.read_by("campaign", "plan", file, code=0)


@pytest.mark.parametrize(
    "place", ["{nth.__class__}", "{nth:>9999999999}", "{nth!r:*^999999999}", "{}", "{0}", "{nth[0]}"]
)
def test_a_fault_of_a_campaign_is_no_template(stranger: Stranger, place: str) -> None:
    text = CAMPAIGN.replace("nth 5", f"nth {place}") + "  draw: {nth: [1, 2]}\n"
    text = text.replace("stop: {experiments: 1}\n", "") + "stop: {experiments: 1}\n"
    shown = stranger.read_by("campaign", "plan", stranger.file("c.yaml", text), code=2)
    assert "stands neither in matrix nor in draw" in shown


def test_a_campaign_file_that_asks_for_too_much(stranger: Stranger) -> None:
    many = "[" + ", ".join(map(str, range(1, 200))) + "]"
    matrix = ", ".join(f"{name}: {many}" for name in "abcdefgh")
    file = stranger.file("c.yaml", CAMPAIGN.replace("stop:", f"  matrix: {{{matrix}}}\nstop:"))
    assert "a matrix of 2459374191553118401 points" in stranger.read_by("campaign", "plan", file, code=2)
    file = stranger.file("c.yaml", CAMPAIGN.replace("[pbr]", "[" + "pbr, " * 15_000 + "pbr]"))
    assert "15001 strata, allowed are 10000" in stranger.read_by("campaign", "plan", file, code=2)


# -- OpenSCENARIO, DBC, logs --------------------------------------------------------------------------


def test_openscenario_is_data(stranger: Stranger) -> None:
    secret = stranger.file("secret.txt", "the secret")
    good = (INTEROP / "lead_brakes.xosc").read_text()
    head, _, rest = good.partition("?>")
    for entity in (
        f'<!ENTITY x SYSTEM "{secret.as_uri()}">',
        '<!ENTITY x "y">',
        f'<!ENTITY % p SYSTEM "{secret}"> %p;',
    ):
        file = stranger.file(
            "a.xosc", f"{head}?><!DOCTYPE OpenSCENARIO [{entity}]>{rest.replace('Ego', '&x;')}"
        )
        shown = stranger.read_by("scenario", "import", file, "--out", stranger.out, code=2)
        assert "DOCTYPE: not allowed" in shown and "the secret" not in shown
    assert list(stranger.out.iterdir()) == []


def test_values_of_a_distribution_name_no_other_place(stranger: Stranger) -> None:
    shutil.copy(INTEROP / "lead_brakes.xosc", stranger.folder / "lead_brakes.xosc")
    values = (INTEROP / "lead_brakes_values.xosc").read_text()
    for name in ("../../mine.txt", "/mine", "..", "a/../../b", ESCAPE[-2:]):
        file = stranger.file("values.xosc", values.replace('value="', f'value="{name}', 1))
        words = ("scenario", "import", "lead_brakes.xosc", "--variations", file, "--out", stranger.out)
        stranger.read_by(*words, code=2)


def test_a_link_in_the_output_folder_is_not_followed(stranger: Stranger) -> None:
    shutil.copy(INTEROP / "lead_brakes.xosc", stranger.folder / "lead_brakes.xosc")
    link = stranger.out / "lead_brakes.yaml"
    for target, options in ((stranger.mine, ("--force",)), (stranger.root / "new", ())):
        link.unlink(missing_ok=True)
        link.symlink_to(target)
        stranger.read_by("scenario", "import", "lead_brakes.xosc", "--out", stranger.out, *options, code=0)
        assert link.is_file() and not link.is_symlink()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.mf4", b"MDF     4.10    " + b"\x80\x04cos\nsystem\n" * 100),
        ("a.blf", b"LOGG" + b"\xff" * 200),
        ("a.asc", f"date {ESCAPE}\nbase hex\n{SCRIPT}\n".encode()),
        ("a.trc", f";$FILEVERSION={ESCAPE}\n".encode()),
        ("a.log", f"(0000000001.000000) {ESCAPE} 130#00\n".encode()),
    ],
)
def test_logs_are_data(stranger: Stranger, name: str, content: bytes) -> None:
    stranger.read_by("log", "convert", stranger.file(name, content), stranger.out / "b.log", code=2)
    assert list(stranger.out.iterdir()) == []


def test_a_dbc_is_data(stranger: Stranger) -> None:
    log = stranger.file("a.log", "(0000000001.000000) can0 130#0000000000000000\n")
    for name in ("../../mine", SCRIPT, ESCAPE, "__import__('evil')"):
        text = f'VERSION "{name}"\nBU_: x\nBO_ 304 {name}: 8 x\n SG_ {name} : 0|8@1+ (1,0) [0|0] "{name}" x\n'
        dbc = stranger.file("a.dbc", text)
        stranger.read_by("log", "convert", log, stranger.out / "a.csv", "--dbc", dbc, code=2)
    assert list(stranger.out.iterdir()) == []


def test_a_log_is_not_written_through_a_link_beside_its_sink(stranger: Stranger) -> None:
    """The name of a temporary file that can be guessed could be a link that someone else has put there."""
    log = stranger.file("a.log", "(0000000001.000000) can0 130#00\n")
    (stranger.out / f".b.asc.{os.getpid()}.part").symlink_to(stranger.mine)
    (stranger.out / "b.asc").symlink_to(stranger.mine)
    stranger.read_by("log", "convert", log, stranger.out / "b.asc", code=0)
    assert not (stranger.out / "b.asc").is_symlink()


# -- records of runs --------------------------------------------------------------------------------


def record(stranger: Stranger, source: str, **about: object) -> Path:
    """The record of a run that was updated to `source`, with these keys of `run.json`."""
    path = stranger.folder / "record"
    shutil.rmtree(path)
    run = whole(path)
    run.note("a.protocol.1", Event.REPLY_STORED, 0)
    run.end = {"reason": ESCAPE, **(run.end or {})} | {"reason": ESCAPE}
    run.verdict()
    stranger.file("record/evil.py", EVIL.format(sentinel=str(stranger.sentinel)))
    adapted = {"application": source, "opened_ns": 1, "asked": ESCAPE, "reason": ESCAPE}
    stranger.file("record/adaptations.jsonl", outcomes(adapted))
    stranger.file("record/events.jsonl", json.dumps({"t_ms": 1, "event": ESCAPE, "text": SCRIPT}) + "\n")
    known = json.loads((path / "run.json").read_text())
    stranger.file("record/run.json", json.dumps(known | about))
    return path


@pytest.mark.parametrize(
    "source",
    ["evil_package.inner:Evil", "{folder}/record/evil.py:Evil", f"{ESCAPE}:Evil"]
    + [
        pytest.param(source, marks=pytest.mark.deep)
        for source in (
            *("evil:Evil", "evil_package:Evil", "evil.py:Evil", "record/evil.py:Evil"),
            *("yaml:Evil", "os:system", "../evil.py:Evil"),
        )
    ],
)
def test_a_record_is_judged_without_its_code(stranger: Stranger, source: str) -> None:
    source = source.format(folder=stranger.folder)
    elsewhere = str(stranger.root / "mine.txt")
    path = record(stranger, source, record=elsewhere, run="../../mine.txt", ftm="pbr")
    shown = stranger.read_by("check", path, code=3)
    assert "one_history unknown" in shown and "verdict: inconclusive" in shown
    assert "--trust" in shown or "cannot be read" in shown
    stranger.read_by("check", path, "--json", code=3)
    stranger.read_by("sim", "--against", path, "--seeds", "0..0", code=1)
    stranger.read_by("log", "export", path, "--trace", stranger.out / "t.json", code=0)
    stranger.read_by("log", "export", path, "--mcap", stranger.out / "t.mcap", code=0)
    assert {one.name for one in stranger.out.iterdir()} == {"t.json", "t.mcap"}


@pytest.mark.parametrize("name", ["run.json", "end.json", "adaptations.jsonl", "journal/proxy.1.journal"])
def test_a_record_with_a_device_in_it_is_refused(stranger: Stranger, name: str) -> None:
    path = record(stranger, "")
    (path / name).unlink(missing_ok=True)
    (path / name).symlink_to("/dev/zero")
    assert "not a regular file" in stranger.read_by("check", path, code=2)


# -- campaigns --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of a simulated campaign of one experiment."""
    folder = tmp_path_factory.mktemp("campaign")
    (folder / "c.yaml").write_text(CAMPAIGN)
    done = called("campaign", "run", folder / "c.yaml", "--out", folder / "out", "--jobs", "1")
    assert done.code == 1, "one experiment proves little"
    yield folder / "out"


def ledger(stranger: Stranger, ran: Path, name: str = "campaign", **changes: object) -> Path:
    """A copy in which the experiment has these keys."""
    head, line = (ran / NAME).read_text().splitlines()
    result = json.loads(line)
    result["experiment"] |= changes
    stranger.file(f"{name}/{NAME}", f"{head}\n{json.dumps(result)}\n")
    return stranger.folder / name


UPDATES: Final = [
    f"update {part} to {source} at request 3"
    for part, source in (
        ("app", "evil:Evil"),
        ("app", "evil.py:Evil"),
        ("app", "evil_package.inner:Evil"),
        ("after", "evil:Evil"),
    )
]


@pytest.mark.parametrize(("runtime", "update"), sampled(("sim", "unix"), UPDATES))
def test_a_campaign_is_read_without_its_code(
    stranger: Stranger, ran: Path, update: str, runtime: str
) -> None:
    folder = ledger(stranger, ran, adaptations=[update], runtime=runtime)
    shown = stranger.read_by("campaign", "replay", folder, "0", code=2)
    assert ("is not trusted" in shown and "--trust" in shown) or "cannot be read: no module" in shown
    stranger.read_by("campaign", "compare", folder, folder, code=0)
    stranger.read_by("campaign", "export", folder, "--out", stranger.out / "t.csv", code=0)
    stranger.read_by("campaign", "merge", folder, "--out", stranger.out / "merged", code=1)
    stranger.read_by("campaign", "shrink", folder, "0", code=0)
    stranger.read_by("campaign", "assumptions", folder, code=2 if " app " in update else 0)


@pytest.mark.parametrize("runtime", ["sim", "unix"])
@pytest.mark.parametrize("app", ["evil:Evil", "evil.py:Evil", "sh evil.sh", "evil.so"])
def test_a_campaign_whose_function_is_a_strangers_is_read_without_it(
    stranger: Stranger, ran: Path, app: str, runtime: str
) -> None:
    folder = ledger(stranger, ran, app=app, runtime=runtime)
    shown = stranger.read_by("campaign", "replay", folder, "0", code=2)
    assert "is not trusted" in shown or "cannot be read: " in shown, shown
    stranger.read_by("campaign", "shrink", folder, "0", code=2)
    shutil.move(folder, stranger.out / "campaign")
    stranger.read_by("campaign", "report", stranger.out / "campaign", code=1)


@pytest.mark.parametrize("runtime", ["sim", "unix"])
@pytest.mark.parametrize(
    "source", ["evil:Evil", "evil.py:Evil", "evil_package.inner:Evil", "{folder}/evil.py:Evil"]
)
def test_a_campaign_whose_requests_a_strangers_function_makes_is_read_without_it(
    stranger: Stranger, ran: Path, source: str, runtime: str
) -> None:
    source = source.format(folder=stranger.folder)
    folder = ledger(stranger, ran, request_file=source, runtime=runtime)
    shown = stranger.read_by("campaign", "replay", folder, "0", code=2)
    assert "is not trusted" in shown or "cannot be read: " in shown, shown
    assert "no code from outside" in stranger.read_by("campaign", "shrink", folder, "0", code=2)
    shutil.move(folder, stranger.out / "campaign")
    stranger.read_by("campaign", "report", stranger.out / "campaign", code=1)


def test_a_ledger_whose_spec_names_code_is_reported_without_it(stranger: Stranger, ran: Path) -> None:
    """Nobody is asked what it declares, and nothing of it has to be there."""
    folder = ledger(stranger, ran, app="evil.py:Evil", request_file="evil.py:Evil")
    head, result = (folder / NAME).read_text().splitlines()
    named = json.loads(head)
    named["spec"]["system"] |= {"app": "evil.py:Evil", "request_file": "evil.py:Evil"}
    for mechanisms in (["pbr"], ["suitable"]):
        named["spec"]["mechanisms"] = mechanisms
        named["spec"]["campaign"] = "evil"
        stranger.file(f"campaign/{NAME}", f"{json.dumps(named)}\n{result}\n")
        shutil.copytree(folder, stranger.out / mechanisms[0])
        stranger.read_by("campaign", "report", stranger.out / mechanisms[0], code=1)
        assert (stranger.out / mechanisms[0] / MARKDOWN).exists()


@pytest.mark.parametrize("key", ["app", "request_file"])
def test_a_campaign_file_that_names_functions_is_planned_without_them(stranger: Stranger, key: str) -> None:
    """The function would be asked what suits it, and the command line does not name it."""
    named = CAMPAIGN.replace("runtime: sim", f'runtime: sim, {key}: "evil.py:Evil"')
    stranger.read_by("campaign", "plan", stranger.file("c.yaml", named), code=0)
    file = stranger.file("c.yaml", named.replace("[pbr]", "[suitable]"))
    shown = stranger.read_by("campaign", "plan", file, code=2 if key == "app" else 0)
    assert ("is not trusted, so it was not executed" in shown) == (key == "app")


def test_the_reports_of_a_campaign_replace_links(stranger: Stranger, ran: Path) -> None:
    folder = ledger(stranger, ran, adaptations=[UPDATES[0]], stratum=f"{SCRIPT}{ESCAPE}../../mine")
    shutil.move(folder, stranger.out / "campaign")
    for name in (SUMMARY, JUNIT, HTML):
        (stranger.out / "campaign" / name).symlink_to(stranger.mine)
    stranger.read_by("campaign", "report", stranger.out / "campaign", code=1)
    names = {path.name for path in (stranger.out / "campaign").iterdir()}
    assert names == {NAME, SUMMARY, JUNIT, HTML}
    assert "<script" not in (stranger.out / "campaign" / HTML).read_text()
    assert stranger.mine.read_text() == "of the user"


@pytest.mark.parametrize(
    "changes", [{"requests": 10**12}, {"requests": -1}, {"rate_hz": 1e300}, {"seed": "1"}]
)
def test_an_experiment_that_no_campaign_has_is_refused(
    stranger: Stranger, ran: Path, changes: dict[str, object]
) -> None:
    folder = ledger(stranger, ran, **changes)
    for words in (("report", folder), ("replay", folder, "0"), ("compare", folder, folder)):
        assert "line 2" in stranger.read_by("campaign", *words, code=2)


def test_a_function_of_a_stranger_is_not_put_into_a_bundle(stranger: Stranger, ran: Path) -> None:
    folder = ledger(stranger, ran)
    head, result = (folder / NAME).read_text().splitlines()
    named = json.loads(head)
    for key, value in {"app": "evil.py:Evil", "request_file": str(stranger.mine)}.items():
        other = named | {"spec": named["spec"] | {"system": named["spec"]["system"] | {key: value}}}
        stranger.file(f"campaign/{NAME}", f"{json.dumps(other)}\n{result}\n")
        words = ("campaign", "bundle", folder, "--out", stranger.out / "e.zip")
        shown = stranger.read_by(*words, code=2)
        assert ("is not trusted, so it was not executed" in shown) == (key == "app")
    assert not list(stranger.out.iterdir())


def test_a_bundle_is_argued_from_without_its_words(stranger: Stranger, ran: Path) -> None:
    """Whoever makes a bundle makes its hashes, too: what is in it is text, and all that it is."""
    made = entries([read_ledger(ran / NAME)], NOBODY)
    head, line = made[f"try/{NAME}"].data.decode().splitlines()
    result = json.loads(line)
    result |= {"outcome": "sdc", "reasons": [f"{SCRIPT}{ESCAPE}"]}

    def bundle(**changes: object) -> Path:
        result["experiment"] |= changes
        files = made | {f"try/{NAME}": BundledFile(f"{head}\n{json.dumps(result)}\n".encode())}
        sums = "".join(f"{sha256(file.data)}  {one}\n" for one, file in files.items() if one != SUMS)
        return stranger.file("e.zip", archive_of(files | {SUMS: BundledFile(sums.encode())}))

    file, picture = bundle(stratum=f"{SCRIPT}{ESCAPE}"), stranger.out / "a.svg"
    stranger.read_by("campaign", "verify", file, code=0)
    shown = stranger.read_by("campaign", "argument", file, "--plot", picture, code=1)
    assert "G3 failed" in shown and SCRIPT in shown
    assert "<script" not in picture.read_text()
    assert not any(one in picture.read_text() for one in "\x1b\x9b\u202e\x07")
    assert "unknown FTM 'evil'" in stranger.read_by("campaign", "argument", bundle(ftm="evil"), code=2)
