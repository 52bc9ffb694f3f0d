"""Experiments and their verdicts."""
