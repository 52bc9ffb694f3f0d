"""The mechanisms, as tables of bricks. They know nothing of the car, and do no I/O."""
