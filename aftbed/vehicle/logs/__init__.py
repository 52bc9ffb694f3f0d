"""Logs of a CAN bus in the formats that other tools open."""
