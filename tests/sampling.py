"""Which combinations are tried each time; all others are `deep`.

Of real processes the simulator is the twin: what they add (descriptors, signals, shared memory, order of
deaths) does not depend on the combination, so a sample is enough in which each value occurs.
"""

import itertools
from collections.abc import Sequence

import pytest
from _pytest.mark import ParameterSet


def sampled(*axes: Sequence[object]) -> list[ParameterSet]:
    """All combinations, deep but for as many as the longest axis has values: there everything occurs."""
    count = max(map(len, axes))
    chosen = {tuple(axis[number % len(axis)] for axis in axes) for number in range(count)}
    return [
        pytest.param(*values, marks=[] if values in chosen else [pytest.mark.deep])
        for values in itertools.product(*axes)
    ]


def every(step: int, values: Sequence[object]) -> list[ParameterSet]:
    """All values, deep but for each `step`-th. A tuple has one for each name."""
    return [
        pytest.param(
            *(value if isinstance(value, tuple) else (value,)),
            marks=[pytest.mark.deep] if number % step else [],
        )
        for number, value in enumerate(values)
    ]
