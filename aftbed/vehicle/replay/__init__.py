"""Recorded CAN logs of other cars: the player, and the gateway that reads them by a map file."""
