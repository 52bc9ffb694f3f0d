"""Measurements, each beside its bare limit in the same run: on a noisy machine only the ratio is stable."""
