"""The car, the bus and the protected function. Knows nothing of the mechanisms that protect it."""
