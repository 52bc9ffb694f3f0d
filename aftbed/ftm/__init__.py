"""The mechanisms: bricks, their tables, their declarations. Nothing of the car, and no I/O."""
