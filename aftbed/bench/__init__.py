"""Measurements, each beside its bare limit in the same run: only the ratio survives a noisy machine."""
