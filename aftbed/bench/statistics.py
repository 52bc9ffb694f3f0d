"""The summary of a sample of times."""

from aftbed.campaign.statistics import quantile


def summary(values: list[float], digits: int = 1) -> dict[str, float]:
    """p50, p95, p99, max."""
    shares = {"p50": 0.5, "p95": 0.95, "p99": 0.99, "max": 1.0}
    return {name: round(quantile(values, share), digits) for name, share in shares.items()}
