"""Quantiles of a sample, by nearest rank: no value is reported that was not measured."""

import math


def quantile(values: list[float], share: float) -> float:
    """The value that `share` of `values` do not exceed (nearest rank)."""
    assert values and 0 < share <= 1
    ordered = sorted(values)
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


def summary(values: list[float], digits: int = 1) -> dict[str, float]:
    """p50, p95, p99, max."""
    shares = {"p50": 0.5, "p95": 0.95, "p99": 0.99, "max": 1.0}
    return {name: round(quantile(values, share), digits) for name, share in shares.items()}
