"""The protected function: automatic emergency braking (AEB)."""
