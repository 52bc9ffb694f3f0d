"""`aftbed campaign`: many experiments from one file, judged with statistics, ended by a gate.

Statistics and reports need scipy and Jinja2 (0.4 s, 30 MB), so they are imported where they are used.
"""

import re
import shlex
import shutil
import sys
import time
from contextlib import closing
from functools import partial
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
import typer
from msgspec.structs import asdict, replace

from aftbed.campaign import ledger, runner
from aftbed.campaign.experiment import REQUESTS_MAX, Result, carry_out, refuse_untrusted
from aftbed.campaign.plan import CampaignPlan, size_of
from aftbed.campaign.plan import plan as plan_of
from aftbed.campaign.smallest import smallest
from aftbed.campaign.spec import EXPERIMENTS_MAX, Spec, check, read_spec, shipped, spec_path
from aftbed.cli.interrupted import interrupted
from aftbed.cli.options import (
    App,
    Ftti,
    Json,
    Requests,
    TrustedFolders,
    check_file,
    check_range,
    choices,
    jobs_of,
    print_json,
    takes,
)
from aftbed.cli.parsing import PlainGroup
from aftbed.core.errors import ConfigError, shown, unknown
from aftbed.core.yaml_file import in_file
from aftbed.functions.load import OWN_CODE
from aftbed.functions.request_file import located_requests, requests_from
from aftbed.functions.source import located
from aftbed.interop.files import write_text_whole, write_whole
from aftbed.report.export import write_csv, write_parquet
from aftbed.report.progress import ProgressLine
from aftbed.runtime.unix.trust import NOBODY, OWN_RUN, Trust, trusting

if TYPE_CHECKING:
    from aftbed.campaign.summary import Summary

RUNTIMES: Final = ("unix", "sim")
EXECUTORS: Final = ("local", "dask")
SECONDS_EACH: Final = {"unix": 0.35, "sim": 0.01}  # of an experiment on one core: for the estimate of `plan`
EXIT_CODES: Final = {"pass": 0, "fail": 1}
_SHARD: Final = re.compile(r"([0-9]{1,6})/([0-9]{1,6})")

campaign = typer.Typer(cls=PlainGroup)

Folder = Annotated[Path, typer.Argument(help="The directory of a campaign (its --out).")]
BundleFile = Annotated[Path, typer.Argument(metavar="BUNDLE", help="A file of aftbed campaign bundle.")]
ExperimentName = Annotated[str, typer.Argument(help="Id of the experiment, its beginning, or its number.")]


# -- before anything runs -------------------------------------------------------------------------


@campaign.command("list")
def list_(json: Json = False) -> None:
    """The campaigns that come with aftbed."""
    found = {name: read_spec(name).about for name in shipped()}
    if json:
        print_json({"campaigns": [{"name": name, "about": about} for name, about in found.items()]})
        return
    for name, about in found.items():
        print(f"{name:<14} {about}")


@campaign.command()
def schema() -> None:
    """The JSON schema of a campaign file, for editors."""
    print(dumps(msgspec.json.schema(Spec), indent=2))


class CampaignArguments(msgspec.Struct, frozen=True, kw_only=True):
    """A campaign, and the options that override its file."""

    name: Annotated[
        str, typer.Argument(help="Name of a shipped campaign (aftbed campaign list), or a YAML file.")
    ]
    seed: Annotated[int | None, typer.Option(help="Overrides that of the file.")] = None
    experiments: Annotated[
        int | None, typer.Option("--experiments", help="In each stratum; overrides that of the file.")
    ] = None
    runtime: Annotated[
        str | None, typer.Option(metavar=choices(RUNTIMES), help="Overrides that of the file.")
    ] = None
    app: App = None
    requests: Requests = None
    count: Annotated[
        int | None, typer.Option(help="Requests of an experiment; overrides that of the file.")
    ] = None
    ftti: Ftti = None
    json: Json = False


def check_ftti(spec: Spec) -> None:
    """Raise ConfigError if `--ftti` is no FTTI."""
    try:
        assert spec.ftti_ms
    except ConfigError as error:
        raise ConfigError(f"--{error}") from None


def planned(given: CampaignArguments, trust: Trust = NOBODY) -> CampaignPlan:
    """The plan. Raises ConfigError before anything runs.

    `trust`: of a function that the campaign's file names, where it is asked what it declares.
    """
    spec = read_spec(given.name)
    if given.seed is not None:
        if given.seed < 0:
            raise ConfigError(f"--seed {given.seed}: 0 or more is allowed")
        spec = replace(spec, seed=given.seed)
    if given.experiments is not None:
        check_range("--experiments", given.experiments, 1, EXPERIMENTS_MAX)
        spec = replace(spec, stop=replace(spec.stop, experiments=given.experiments))
    if given.runtime is not None:
        if given.runtime not in RUNTIMES:
            raise unknown("runtime", given.runtime, RUNTIMES)
        spec = replace(spec, system=replace(spec.system, runtime=given.runtime))
    if given.app is not None:
        spec = replace(spec, system=replace(spec.system, app=located(given.app)))
        trust = OWN_RUN
    if given.requests is not None:
        spec = replace(spec, system=replace(spec.system, request_file=located_requests(given.requests)))
    if given.count is not None:
        check_range("--count", given.count, 1, REQUESTS_MAX)
        spec = replace(spec, system=replace(spec.system, requests=given.count))
    if given.ftti is not None:
        spec = replace(spec, ftti=given.ftti)
        check_ftti(spec)
    with in_file(spec_path(given.name)):
        check(spec)
        return plan_of(spec, trust)


class PlanArguments(CampaignArguments, frozen=True, kw_only=True):
    """The options of `aftbed campaign plan`."""

    out: Annotated[Path | None, typer.Option(help="Write every experiment to this file, a line each.")] = None
    trust: Annotated[
        tuple[Path, ...],
        typer.Option(
            "--trust", help="Directory whose functions may be executed; may be given several times."
        ),
    ] = ()


@campaign.command()
@takes(PlanArguments)
def plan(given: PlanArguments) -> None:
    """What would be run: the strata, the number of experiments, about how long. Nothing is run."""
    found = planned(given, trusting(given.trust))
    spec = found.spec
    if given.out is not None:
        lines = (msgspec.json.encode(e) + b"\n" for e in found.experiments())
        try:
            given.out.write_bytes(b"".join(lines))
        except OSError as error:
            raise ConfigError(f"--out {given.out}: {error.strerror}") from None
    seconds = round(found.size * SECONDS_EACH[spec.system.runtime], 1)
    if given.json:
        strata = [
            {"name": s.name, "experiments": spec.stop.experiments, "expected": s.expected}
            for s in found.strata
        ]
        about = {"campaign": spec.campaign, "seed": spec.seed, "digest": found.digest, "code": found.code}
        print_json(about | {"experiments": found.size, "seconds": seconds, "strata": strata})
        return
    print(f"{spec.campaign}: {spec.about}" if spec.about else spec.campaign)
    width = max(len(s.name) for s in found.strata)
    for stratum in found.strata:
        expected = f"expected {', '.join(stratum.expected)}" if stratum.expected else ""
        print(f"  {stratum.name:<{width}}  {spec.stop.experiments:>6}  {expected}".rstrip())
    duration = f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
    print(f"{found.size} experiments at most, about {duration} on one core")


# -- running --------------------------------------------------------------------------------------


class CampaignRunArguments(CampaignArguments, frozen=True, kw_only=True):
    """The options of `aftbed campaign run`."""

    out: Annotated[
        Path | None, typer.Option(help="Directory of the records and reports; campaign-NAME if left out.")
    ] = None
    jobs: Annotated[int | None, typer.Option(help="Experiments side by side; one per CPU if left out.")] = (
        None
    )
    shard: Annotated[str, typer.Option(help="I/N: only the Ith of N parts.")] = "1/1"
    resume: Annotated[bool, typer.Option("--resume", help="Run only what is missing in the directory.")] = (
        False
    )
    executor: Annotated[
        str, typer.Option(metavar=choices(EXECUTORS), help="local processes, or dask (needs --scheduler).")
    ] = EXECUTORS[0]
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler.")] = None


@campaign.command()
@takes(CampaignRunArguments)
def run(given: CampaignRunArguments) -> int:
    """Run the experiments, judge the campaign, write its reports.

    Exit code: 0 all gates pass, 1 one does not, 2 usage, 3 trouble of the harness, 130 interrupted.
    """
    found = planned(given, OWN_RUN)  # what the file names is executed anyway
    options = _run_options(found, given)
    system = found.spec.system
    given_requests = None
    if system.request_file:  # what is wrong with it is said once, not by each experiment
        given_requests = requests_from(system.request_file, system.requests, found.spec.seed, OWN_CODE)
    if system.app:
        from aftbed.cli.adapt import tried_out  # noqa: PLC0415 - only with a function of the user
        from aftbed.cli.request_options import first_requests  # noqa: PLC0415 - the same

        tried_out(system.app, first_requests(system.app, given_requests), force=False)
    from aftbed.report.terminal import CampaignProgress  # noqa: PLC0415 - scipy, after the options

    began_s = time.monotonic()
    results = runner.run(found, options)  # raises ConfigError here, before the progress is shown
    todo = sum(options.has(index, len(found.strata)) for index in range(found.size))
    try:
        with closing(results), CampaignProgress(found.spec.campaign, todo, plain=not given.json) as progress:
            for result in results:
                progress.add(result)
    except KeyboardInterrupt:
        return _interrupted(options.out, found.size, time.monotonic() - began_s, as_json=given.json)
    return _judge(options.out, found.size, time.monotonic() - began_s, as_json=given.json)


def _interrupted(folder: Path, size: int, seconds: float, *, as_json: bool) -> int:
    """Say what is kept, then show what is known so far. Reports take seconds: the user may ask for them."""
    from aftbed.campaign.summary import summarise  # noqa: PLC0415 - scipy

    records = _ledger(folder)
    words = sys.argv[1:] if "--resume" in sys.argv else [*sys.argv[1:], "--resume"]
    go_on = shlex.join(("aftbed", *words))
    reports = shlex.join(("aftbed", "campaign", "report", str(folder)))
    kept = f"{len(records.results)} of {size} experiments are kept in {folder}"
    code = interrupted(f"{kept}; go on: {go_on}; reports: {reports}")
    _show(summarise(records, size, seconds), as_json=as_json)
    return code


def _run_options(found: CampaignPlan, given: CampaignRunArguments) -> runner.CampaignRunOptions:
    if given.executor not in EXECUTORS:
        raise unknown("executor", given.executor, EXECUTORS)
    if (given.executor == "dask") != (given.scheduler is not None):
        raise ConfigError("--executor dask and --scheduler ADDRESS go together")
    if given.scheduler is not None and given.jobs is not None:
        raise ConfigError("--jobs: how many there are is the scheduler's to say")
    match = _SHARD.fullmatch(given.shard)
    number, of = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= number <= of:
        raise ConfigError(f"--shard {given.shard[:40]!r}: I/N is allowed, I from 1 to N")
    folder = given.out if given.out is not None else Path(f"campaign-{found.spec.campaign}")
    return runner.CampaignRunOptions(
        folder, jobs_of(given.jobs), number, of, given.resume, given.scheduler or ""
    )


def _ledger(folder: Path) -> ledger.Ledger:
    return ledger.read(folder / ledger.NAME)


def _judge(folder: Path, size: int, seconds: float, *, as_json: bool) -> int:
    """Summarise the ledger, of a campaign of `size` experiments, and write the reports; the exit code."""
    from aftbed.campaign.summary import summarise  # noqa: PLC0415
    from aftbed.report.documents import documents  # noqa: PLC0415 - scipy

    with ProgressLine("campaign", plain=False) as progress:
        progress.step(f"reading {folder}")
        records = _ledger(folder)
        progress.step(f"judging {len(records.results)} experiments")
        summary = summarise(records, size, seconds)
        progress.step("writing the reports")
        for name, text in documents(summary, records).items():
            write_text_whole(folder / name, text)
    _show(summary, as_json=as_json)
    if not as_json:
        print(f"records and reports: {folder}")
    return EXIT_CODES[summary.gate]


def _show(summary: "Summary", *, as_json: bool) -> None:
    from aftbed.report.terminal import summary_lines  # noqa: PLC0415 - scipy

    if as_json:
        print_json(summary)
    else:
        print("\n".join(summary_lines(summary)))


# -- from the records -----------------------------------------------------------------------------


@campaign.command()
def report(folder: Folder, json: Json = False) -> None:
    """Judge the records of a campaign again, and write its reports anew."""
    raise typer.Exit(_report(folder, as_json=json))


def _report(folder: Path, *, as_json: bool) -> int:
    records = _ledger(folder)
    seconds = sum(result.seconds for result in records.results)
    return _judge(folder, size_of(records.head.spec), seconds, as_json=as_json)


@campaign.command()
def export(
    folder: Folder,
    out: Annotated[Path, typer.Option(help="A file: .csv, or .parquet (pip install 'aftbed[parquet]').")],
    json: Json = False,
) -> None:
    """The results as a table, one row each."""
    writers = {".csv": write_csv, ".parquet": write_parquet}
    if out.suffix not in writers:
        raise unknown("kind of file", out.suffix, writers)
    records = _ledger(folder)
    write_whole(out, partial(writers[out.suffix], records))
    if json:
        print_json({"file": str(out), "results": len(records.results)})


@campaign.command()
def merge(
    folders: Annotated[list[Path], typer.Argument(help="The directories of all shards.")],
    out: Annotated[Path, typer.Option(help="A new directory.")],
    json: Json = False,
) -> None:
    """Merge the shards of a campaign, and report on the whole."""
    merged = ledger.merged([_ledger(folder) for folder in folders])
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {out}: cannot be made: {error.strerror}") from None
    path = out / ledger.NAME
    ledger.begin(path, merged.head)
    with open(ledger.opened(path), "wb") as file:
        file.writelines(msgspec.json.encode(result) + b"\n" for result in merged.results)
    for records in (folder / ledger.RECORDS for folder in folders):
        try:
            if records.is_dir():
                shutil.copytree(records, out / ledger.RECORDS, symlinks=True, dirs_exist_ok=True)
        except OSError as error:  # of copytree, a list of what could not be copied
            raise ConfigError(f"{records}: cannot be copied to {out}: {error}") from None
    raise typer.Exit(_report(out, as_json=json))


@campaign.command()
def compare(
    base: Folder,
    new: Folder,
    outcomes: Annotated[
        bool, typer.Option("--outcomes", help="Fail where an experiment has another outcome, or is missing.")
    ] = False,
    json: Json = False,
) -> None:
    """What differs between two campaigns of the same plan, experiment by experiment.

    Exit code: 0 no stratum has become worse, 1 one has, 2 usage.
    """
    from aftbed.campaign.compare import Change  # noqa: PLC0415 - scipy
    from aftbed.campaign.compare import compare as compared  # noqa: PLC0415

    def line(change: Change) -> str:
        shift = "p99 recovery: too few to tell"
        if change.shift_ms is not None:
            shift = f"p99 recovery {change.shift_ms.low:+.3f} to {change.shift_ms.high:+.3f} ms"
        differ = f"{change.other_outcome} with another outcome"
        differ += f" ({change.unknown} unknown)" if change.unknown else ""
        differ += f", {change.only_base} failed only before, {change.only_new} only now (p {change.p:.3g})"
        word = "worse" if change.worse else "same or better"
        return f"  {change.stratum:<{width}}  {change.pairs:>5} pairs: {differ}; {shift}: {word}"

    found = compared(_ledger(base), _ledger(new))
    if json:
        print_json(found)
    else:
        head = f"base {found.base}, new {found.new}; {found.unpaired} experiments without their pair"
        width = max((len(change.stratum) for change in found.changes), default=0)
        print(shown("\n".join((head, *map(line, found.changes)))))
    raise typer.Exit(1 if found.worse or (outcomes and not found.same_outcomes) else 0)


@campaign.command()
def assumptions(folder: Folder, trust: TrustedFolders = None, json: Json = False) -> None:
    """What each mechanism assumes, and the outcomes where that does not hold, as Markdown."""
    from aftbed.campaign.assumptions import cells, markdown  # noqa: PLC0415 - scipy

    if json:
        print_json({"cells": list(cells(_ledger(folder), trusting(trust)))})
        return
    print(shown(markdown(_ledger(folder), trusting(trust))), end="")


# -- evidence that can be filed -------------------------------------------------------------------


@campaign.command()
def bundle(
    folders: Annotated[list[Path], typer.Argument(help="The directories of campaigns.")],
    out: Annotated[Path, typer.Option(help="A file: .zip.")],
    trust: TrustedFolders = None,
    json: Json = False,
) -> None:
    """All that campaigns are evidence by, as an archive that can be verified and run again."""
    from aftbed.report.bundle import SUMS, archive_of, entries, sha256  # noqa: PLC0415 - scipy

    check_file("--out", out, ".zip")
    with ProgressLine("campaign bundle", unit="runs", plain=not json) as progress:
        made = entries([_ledger(folder) for folder in folders], trusting(trust), progress.show)
    data = archive_of(made)
    write_whole(out, lambda path: path.write_bytes(data))
    files = {name: sha256(entry.data) for name, entry in made.items() if name != SUMS}
    if json:
        print_json({"bundle": out.name, "sha256": sha256(data), "files": files})
    else:
        print(shown(f"{out}: {len(files)} files, sha256 {sha256(data)}"))


@campaign.command()
def verify(file: BundleFile, json: Json = False) -> None:
    """Whether each file of a bundle fits its hash. Nothing is unpacked.

    Exit code: 0 all fit, 1 one does not, 2 no bundle.
    """
    from aftbed.report.bundle import verified  # noqa: PLC0415 - scipy

    with ProgressLine("campaign verify", unit="files", plain=not json) as progress:
        found = verified(file, progress.show)
    if json:
        print_json({"bundle": file.name} | asdict(found))
    else:
        lines = [f"{file}: {len(found.files)} files, sha256 {found.sha256}"]
        lines += [f"{one.path}: {one.why}" for one in found.misfits] or ["all fit"]
        print(shown("\n".join(lines)))
    raise typer.Exit(1 if found.misfits else 0)


@campaign.command()
def argument(
    file: BundleFile,
    plot: Annotated[Path | None, typer.Option(help="Draw it to this SVG file.")] = None,
    json: Json = False,
) -> None:
    """A safety argument from a bundle, in GSN: promises, mechanisms, what was measured, and its hash.

    Exit code: 0 each campaign supports its goals, 1 one does not, or a file does not fit its hash, 2 usage.
    """
    from aftbed.report.argument import argument_lines, argument_of  # noqa: PLC0415 - scipy
    from aftbed.report.bundle import campaigns_in, verified  # noqa: PLC0415

    check_file("--plot", plot, ".svg")
    with ProgressLine("campaign argument", unit="files", plain=not json) as progress:
        checked = verified(file, progress.show)
    if checked.misfits:
        for one in checked.misfits:
            print(shown(f"aftbed: {file}: {one.path}: {one.why}"), file=sys.stderr)
        raise typer.Exit(1)
    found = argument_of(file.name, checked, campaigns_in(file))
    if plot is not None:
        from aftbed.report.gsn import gsn_svg  # noqa: PLC0415

        write_text_whole(plot, gsn_svg(found))
    if json:
        print_json(found)
    else:
        print(shown("\n".join(argument_lines(found))))
    raise typer.Exit(0 if found.holds else 1)


# -- one experiment -------------------------------------------------------------------------------


@campaign.command()
def replay(
    folder: Folder, experiment: ExperimentName, trust: TrustedFolders = None, json: Json = False
) -> None:
    """Run one experiment of a campaign again.

    Exit code: 0 the outcome is the same, 1 it is not, 2 usage.
    """
    before = ledger.find(_ledger(folder), experiment)
    refuse_untrusted(before.experiment, trusting(trust))
    after = carry_out(before.experiment, lambda result: None)
    if json:
        print_json({"before": before, "after": after})
    else:
        print(shown(f"{_title(before)}\n  then  {_outcome(before)}\n  now   {_outcome(after)}"))
        print(shown(before.experiment.command()))
    raise typer.Exit(0 if after.outcome == before.outcome else 1)


@campaign.command()
def shrink(folder: Folder, experiment: ExperimentName, json: Json = False) -> None:
    """The smallest experiment with the same outcome, in the simulator.

    A real experiment is shrunk in the simulator, too: there a run is repeated to the last event.
    """
    before = ledger.find(_ledger(folder), experiment)
    with ProgressLine("campaign shrink", unit="runs", plain=not json) as progress:
        found = smallest(before, progress.show)
    if json:
        print_json(found)
    else:
        print(shown(f"{_title(before)}\n  outcome  {_outcome(before)}\n  smallest  {found.command()}"))


def _title(result: Result) -> str:
    experiment = result.experiment
    return f"{experiment.id} (number {experiment.index}): {experiment.stratum}, seed {experiment.seed}"


def _outcome(result: Result) -> str:
    because = f": {'; '.join(result.reasons)}" if result.reasons else ""
    return f"{result.outcome}{because}"
