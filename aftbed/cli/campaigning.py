"""What `aftbed campaign` does: reads, plans, runs, judges, reports."""

import json
import re
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Final

import msgspec

from aftbed.campaign import ledger, runner
from aftbed.campaign.experiment import Experiment, Result, carry_out
from aftbed.campaign.ledger import Ledger
from aftbed.campaign.plan import Plan, plan
from aftbed.campaign.spec import EXPERIMENTS_MAX, Spec, check, read_spec, shipped
from aftbed.cli.simasked import jobs_of
from aftbed.core.errors import ConfigError, unknown
from aftbed.judge.verdict import EXIT_INTERRUPTED

RUNTIMES: Final = ("unix", "sim")
EXECUTORS: Final = ("local", "dask")
SECONDS_EACH: Final = {"unix": 0.35, "sim": 0.01}  # for an estimate: on one core
EXIT_CODES: Final = {"pass": 0, "fail": 1}
SUMMARY: Final = "summary.json"
JUNIT: Final = "junit.xml"
HTML: Final = "report.html"
_SHARD: Final = re.compile(r"([0-9]{1,6})/([0-9]{1,6})")


class Changes(msgspec.Struct, frozen=True):
    """The campaign, and what the command line has in the place of what its file says."""

    name: str
    seed: int | None = None
    experiments: int | None = None
    runtime: str | None = None


def made(changes: Changes) -> Plan:
    """The plan. Raises ConfigError before anything runs."""
    spec = read_spec(changes.name)
    if changes.seed is not None:
        if changes.seed < 0:
            raise ConfigError(f"--seed {changes.seed}: 0 or more is allowed")
        spec = msgspec.structs.replace(spec, seed=changes.seed)
    if changes.experiments is not None:
        if not 1 <= changes.experiments <= EXPERIMENTS_MAX:
            raise ConfigError(f"--experiments {changes.experiments}: 1 to {EXPERIMENTS_MAX} are allowed")
        stop = msgspec.structs.replace(spec.stop, experiments=changes.experiments)
        spec = msgspec.structs.replace(spec, stop=stop)
    if changes.runtime is not None:
        if changes.runtime not in RUNTIMES:
            raise unknown("runtime", changes.runtime, RUNTIMES)
        system = msgspec.structs.replace(spec.system, runtime=changes.runtime)
        spec = msgspec.structs.replace(spec, system=system)
    try:
        check(spec)
        return plan(spec)
    except ConfigError as error:
        raise ConfigError(f"{changes.name}: {error}") from error


# -- before anything runs -------------------------------------------------------------------------


def show_shipped() -> None:
    """Name and purpose."""
    for name in shipped():
        spec = read_spec(name)
        print(f"{name:<14} {spec.about}")


def show_schema() -> None:
    """For an editor."""
    print(json.dumps(msgspec.json.schema(Spec), indent=2))


def show_plan(changes: Changes, out: Path | None, *, as_json: bool) -> None:
    """The strata, and how long it will take."""
    found = made(changes)
    spec = found.spec
    if out is not None:
        lines = (msgspec.json.encode(e) + b"\n" for e in found.experiments())
        try:
            out.write_bytes(b"".join(lines))
        except OSError as error:
            raise ConfigError(f"--out {out}: {error.strerror}") from None
    seconds = round(found.size * SECONDS_EACH[spec.system.runtime], 1)
    strata = [
        {"name": s.name, "experiments": spec.stop.experiments, "expected": list(s.expected)}
        for s in found.strata
    ]
    if as_json:
        about = {"campaign": spec.campaign, "seed": spec.seed, "digest": found.digest, "code": found.code}
        print(json.dumps(about | {"experiments": found.size, "seconds": seconds, "strata": strata}))
        return
    print(f"{spec.campaign}: {spec.about}" if spec.about else spec.campaign)
    width = max(len(s.name) for s in found.strata)
    for stratum in found.strata:
        expected = f"expected {', '.join(stratum.expected)}" if stratum.expected else ""
        print(f"  {stratum.name:<{width}}  {spec.stop.experiments:>6}  {expected}".rstrip())
    print(f"{found.size} experiments at most, about {_duration(seconds)} on one core")


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


# -- running --------------------------------------------------------------------------------------


class How(msgspec.Struct, frozen=True):
    """The options of `aftbed campaign run` as they were typed; None is what was left out."""

    out: Path | None = None
    jobs: int | None = None
    shard: str = "1/1"
    resume: bool = False
    executor: str = EXECUTORS[0]
    scheduler: str | None = None


def run(changes: Changes, how: How, *, as_json: bool) -> int:
    """Run what is to be run, judge it, write the reports; the exit code."""
    found = made(changes)
    asked = _asked(found, how)
    began_s = time.monotonic()
    interrupted = _follow(found, asked, as_json=as_json)
    code = _judge(asked.out, found.size, time.monotonic() - began_s, as_json=as_json)
    return EXIT_INTERRUPTED if interrupted else code


def _asked(found: Plan, how: How) -> runner.Asked:
    if how.executor not in EXECUTORS:
        raise unknown("executor", how.executor, EXECUTORS)
    if (how.executor == "dask") != (how.scheduler is not None):
        raise ConfigError("--executor dask and --scheduler ADDRESS go together")
    if how.scheduler is not None and how.jobs is not None:
        raise ConfigError("--jobs: how many there are is the scheduler's to say")
    number, of = _shard(how.shard)
    folder = how.out if how.out is not None else Path(f"campaign-{found.spec.campaign}")
    return runner.Asked(folder, jobs_of(how.jobs), number, of, how.resume, how.scheduler or "")


def _shard(text: str) -> tuple[int, int]:
    match = _SHARD.fullmatch(text)
    number, of = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= number <= of:
        raise ConfigError(f"--shard {text[:40]!r}: I/N is allowed, I from 1 to N")
    return number, of


def _follow(found: Plan, asked: runner.Asked, *, as_json: bool) -> bool:
    """Show results as they come; True if the user broke it off."""
    from aftbed.report.terminal import Progress  # noqa: PLC0415

    results = runner.run(found, asked)  # refuses what it refuses before anything is shown
    todo = sum(asked.has(index, len(found.strata)) for index in range(found.size))
    try:
        with closing(results), Progress(found.spec.campaign, todo, quiet=as_json) as progress:
            for result in results:
                progress.add(result)
    except KeyboardInterrupt:
        print("interrupted: --resume goes on from here", file=sys.stderr)
        return True
    return False


def _judge(folder: Path, planned: int, seconds: float, *, as_json: bool) -> int:
    """The summary of what is in the ledger, and its reports."""
    from aftbed.campaign.summary import summarise  # noqa: PLC0415
    from aftbed.report.html import html_report  # noqa: PLC0415 - scipy, Jinja2
    from aftbed.report.junit import junit_xml  # noqa: PLC0415
    from aftbed.report.terminal import summary_lines  # noqa: PLC0415

    records = ledger.read(folder / ledger.NAME)
    summary = summarise(records, planned, seconds)
    document = msgspec.json.encode(summary)
    (folder / SUMMARY).write_bytes(msgspec.json.format(document))
    (folder / JUNIT).write_text(junit_xml(summary, records), encoding="utf-8")
    (folder / HTML).write_text(html_report(summary, records), encoding="utf-8")
    if as_json:
        print(document.decode())
    else:
        print("\n".join(summary_lines(summary)))
        print(f"records and reports: {folder}")
    return EXIT_CODES[summary.gate]


def report(folder: Path, *, as_json: bool) -> int:
    """Anew, from the records."""
    records = ledger.read(folder / ledger.NAME)
    planned = len(plan(records.head.spec).strata) * records.head.spec.stop.experiments
    seconds = sum(result.seconds for result in records.results)
    return _judge(folder, planned, seconds, as_json=as_json)


def merge(folders: list[Path], out: Path, *, as_json: bool) -> int:
    """One ledger out of several; then as `report`."""
    merged = ledger.merged([ledger.read(folder / ledger.NAME) for folder in folders])
    out.mkdir(parents=True, exist_ok=True)
    path = out / ledger.NAME
    ledger.begin(path, merged.head)
    with open(ledger.opened(path), "wb") as file:
        file.writelines(msgspec.json.encode(result) + b"\n" for result in merged.results)
    return report(out, as_json=as_json)


def export(folder: Path, out: Path) -> None:
    """By the ending of the file."""
    from aftbed.report.export import write_csv, write_parquet  # noqa: PLC0415

    writers = {".csv": write_csv, ".parquet": write_parquet}
    if out.suffix not in writers:
        raise unknown("kind of file", out.suffix, writers)
    writers[out.suffix](ledger.read(folder / ledger.NAME), out)


# -- one experiment -------------------------------------------------------------------------------


def _one(folder: Path, name: str) -> tuple[Ledger, Result]:
    records = ledger.read(folder / ledger.NAME)
    return records, ledger.find(records, name)


def replay(folder: Path, name: str, *, as_json: bool) -> int:
    """Run it again: 0 if it comes to the same, 1 if not."""
    _, before = _one(folder, name)
    after = carry_out(before.experiment, lambda result: None)
    if as_json:
        print(json.dumps({"before": msgspec.to_builtins(before), "after": msgspec.to_builtins(after)}))
    else:
        print("\n".join((_words(before), f"  then  {_came(before)}", f"  now   {_came(after)}")))
        print(before.experiment.command())
    return 0 if after.outcome == before.outcome else 1


def _words(result: Result) -> str:
    experiment = result.experiment
    return f"{experiment.id} (number {experiment.index}): {experiment.stratum}, seed {experiment.seed}"


def _came(result: Result) -> str:
    because = f": {'; '.join(result.reasons)}" if result.reasons else ""
    return f"{result.outcome}{because}"


def shrink(folder: Path, name: str, *, as_json: bool) -> int:
    """In the simulator, whatever it ran on: there a run is repeated to the last event."""
    from aftbed.campaign.experiment import smallest  # noqa: PLC0415

    _, before = _one(folder, name)
    found: Experiment = smallest(before)
    if as_json:
        print(msgspec.json.encode(found).decode())
    else:
        print("\n".join((_words(before), f"  outcome  {_came(before)}", f"  smallest  {found.command()}")))
    return 0
