"""What the tests of policies share: actions, files, and conditions on a resource with an oracle for them."""

from pathlib import Path
from typing import Final

from hypothesis import strategies as st

from aftbed.adapt.policy import NS_PER_S, Action, Beyond, Policy, PolicyFile, policy_from
from aftbed.core.yaml_file import in_file, read_yaml
from aftbed.ftm.compose import DUPLEX, EXPRESSIONS, SIMPLEX

S: Final = NS_PER_S
ADAPTABLE: Final = EXPRESSIONS[1:]  # all but `none`
COMPOSE, DECOMPOSE = Action("compose", "tr"), Action("decompose")
TO_LFR, TO_PBR = Action("switch", "lfr"), Action("switch", "pbr")
ACTIONS: Final = (
    *(Action("to", e) for e in ADAPTABLE),
    *(Action("switch", name) for name in DUPLEX),
    *(Action("compose", name) for name in SIMPLEX),
    DECOMPOSE,
)


def read(tmp_path: Path, *rules: str, dwell: str = "5") -> Policy:
    """The policy of a file with these rules."""
    path = tmp_path / "mine.yaml"
    path.write_text(f"dwell_s: {dwell}\nrules:\n" + "".join(f"  - {{{rule}}}\n" for rule in rules))
    return policy_at(path)


def policy_at(path: Path) -> Policy:
    """The policy of a file."""
    file = read_yaml(path, PolicyFile)
    with in_file(path):
        return policy_from(file)


levels = st.integers(0, 8).map(float)


@st.composite
def beyonds(draw: st.DrawFn) -> Beyond:
    """Conditions on one resource."""
    above, threshold = draw(st.booleans()), draw(levels)
    until = draw(levels.filter(lambda value: value <= threshold if above else value >= threshold))
    return Beyond("cpus", above, threshold, until, draw(st.integers(0, 3)))


def beyond_oracle(when: Beyond, samples: list[tuple[int, float]]) -> list[bool]:
    """After each sample, whether the condition holds; samples of one instant count in their order."""
    found, held = list[bool](), False
    for count, (t_ns, value) in enumerate(samples, 1):
        run = 0
        while run < count and when.begins(samples[count - 1 - run][1]):
            run += 1
        begun = run > 0 and t_ns - samples[count - run][0] >= when.for_ns
        held = not when.ends(value) if held else begun
        found.append(held)
    return found
