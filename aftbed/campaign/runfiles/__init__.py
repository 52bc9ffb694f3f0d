"""The record of a run as files that other tools open: MCAP for Foxglove, a trace for Perfetto."""
