"""Adaptation: graph differences, scripts, the engine; whether a mechanism suits; when to change it."""
