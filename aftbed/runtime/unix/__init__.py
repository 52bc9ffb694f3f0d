"""The executive support on real Unix processes."""
