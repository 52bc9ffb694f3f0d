"""Which combinations real processes are asked for each time; all of them are `deep`.

The simulator is the twin: it has every combination in the fast tier. What real processes add (descriptors,
signals, shared memory, order of deaths) does not depend on the combination, so a sample is enough in which
each value occurs.
"""

import itertools
from collections.abc import Sequence

import pytest
from _pytest.mark import ParameterSet


def sampled(*axes: Sequence[str]) -> list[ParameterSet]:
    """All combinations, deep but for as many as the longest axis has values: there everything occurs."""
    chosen = set()
    for number in range(max(map(len, axes))):
        first, *others = axes
        values, stride = [first[number % len(first)]], 1
        for axis in others:
            values.append(axis[number // stride % len(axis)])
            stride *= len(axis)
        chosen.add(tuple(values))
    return [
        pytest.param(*values, marks=[] if values in chosen else [pytest.mark.deep])
        for values in itertools.product(*axes)
    ]


def every(step: int, values: Sequence[str]) -> list[ParameterSet]:
    """All values, deep but for each `step`-th."""
    return [
        pytest.param(value, marks=[pytest.mark.deep] if number % step else [])
        for number, value in enumerate(values)
    ]
