"""The kinds of spares: what a node needs must have been imported before it is forked."""

from typing import Final

LIGHT: Final = "zygote"  # bricks
BUS: Final = "zygote.bus"  # and CAN
