"""The list of bugs fits the code of today: each can be planted, and what comes of it compiles."""

from pathlib import Path
from typing import Final

import pytest
from source_mutants import MUTANTS, SourceMutant, planted

ROOT: Final = Path(__file__).parents[2]


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_bug_can_be_planted(mutant: SourceMutant) -> None:
    right = (ROOT / mutant.path).read_text()
    wrong = planted(mutant, right)
    assert wrong != right
    compile(wrong, mutant.path, "exec")
    assert mutant.tests and all((ROOT / test.partition("::")[0]).exists() for test in mutant.tests)


def test_each_bug_is_another_one() -> None:
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS)
