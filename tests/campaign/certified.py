"""The shipped suite over the functions of `strangers`, cut down to a few mechanisms and experiments."""

from pathlib import Path
from typing import Final

from msgspec.structs import replace

from aftbed.campaign.experiment import carry_out
from aftbed.campaign.ledger import Ledger, head_of
from aftbed.campaign.plan import plan, suited
from aftbed.campaign.spec import SUITABLE, Spec, read_spec
from aftbed.campaign.summary import Summary, summarise
from aftbed.functions.load import OWN_CODE, characteristics_of

STRANGERS: Final = Path(__file__).with_name("strangers.py")
REQUESTS: Final = "n:u32\n" + "".join(f"{number * 7919 % 100_000}\n" for number in range(40))


def requests_in(folder: Path) -> Path:
    """A file of forty requests."""
    path = folder / "requests.csv"
    path.write_text(REQUESTS)
    return path


def suite(folder: Path, function: str, mechanisms: tuple[str, ...], *faults: str) -> Spec:
    """Of `certify`: these mechanisms, if they suit, and these faults, or all."""
    spec = read_spec("certify")
    assert spec.mechanisms == (SUITABLE,)
    source = f"{STRANGERS}:{function}"
    spec = suited(spec, characteristics_of(source, OWN_CODE))
    left = tuple(ftm for ftm in spec.mechanisms if ftm in mechanisms)
    adaptations = tuple(
        replace(entry, mechanisms=tuple(ftm for ftm in entry.mechanisms if ftm in left))
        for entry in spec.adaptations
        if entry.name == "steady" or entry.name.removeprefix("to ") in left
    )
    return replace(
        spec,
        mechanisms=left,
        adaptations=tuple(e for e in adaptations if e.mechanisms or e.name == "steady"),
        faults=tuple(e for e in spec.faults if (not faults or e.name in faults)),
        leave_out=(),
        system=replace(spec.system, app=source, request_file=str(requests_in(folder))),
    )


def certified(spec: Spec, experiments: int = 1) -> tuple[Ledger, Summary]:
    """Carried out in the simulator."""
    made = plan(replace(spec, stop=replace(spec.stop, experiments=experiments)))
    results = tuple(carry_out(one, lambda _: None) for one in made.experiments())
    ledger = Ledger(Path("records.jsonl"), head_of(made), results)
    return ledger, summarise(ledger, len(results), 1.0)
