"""Drives and what they must come to: scenario files, the shipped ones, and published tables."""
