"""The figures of the paper, as data: M. Amy, *Adaptive Fault Tolerance: Is ROS a Relevant Executive
Support?*

Section IV, DSN 2016 Student Forum, hal-01318364. What is not here is not sourced here, and is left out
rather than guessed. How they measured, as far as it matters for a comparison: a dual core of 2.5 GHz of
2014, ROS 1; recovery without the time that detection takes; an adaptation stops the Protocol while it
lasts, so its duration is the time in which nobody is served.
"""

from typing import Final

import msgspec

TITLE: Final = "M. Amy, Adaptive Fault Tolerance: Is ROS a Relevant Executive Support?"
PLACE: Final = "DSN 2016 Student Forum"
IDENTIFIER: Final = "hal-01318364"
MACHINE: Final = "dual core of 2.5 GHz, 2014, ROS 1"


class Published(msgspec.Struct, frozen=True):
    """A range of times (ms) or a count, and what is to be known of it."""

    low: float
    high: float
    note: str = ""


CYCLE_PBR: Final = Published(4.0, 5.0)
CYCLE: Final = Published(4.0, 10.0, "of all mechanisms together")
RECOVERY: Final = Published(1.0, 2.0, "without detection")
ADAPTATION: Final = Published(300.0, 300.0, "of any kind")
PROCESSES: Final = {"pbr": 17, "pbr+tr": 23}

# Not of the paper: its graph on ROS 1 with rospy, as this project measured it on two cores of today.
ROSPY_CYCLE_MS: Final = 0.6

NOT_SOURCED: Final = (
    "Initialisation: the paper has a figure, which is not sourced here; ours stands alone.",
    "Cycles of LFR and of the compositions: only their common range is sourced, 4 to 10 ms.",
)
