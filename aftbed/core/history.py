"""The history that a run leaves behind: the records of all its nodes, and what the client sent and received.

Real processes and the simulator produce the same type, so one judge reads both.
"""

import msgspec

from aftbed.core.events import Event
from aftbed.core.journal import Entry, Record


class History(msgspec.Struct, frozen=True):
    """`journals` maps the name of each journal to its records, in their order."""

    journals: dict[str, list[Record]]
    dialogue: list[Entry]
    dropped: int = 0  # records that found no room: what they told is not known

    def events(self, *wanted: Event) -> list[Record]:
        """The records of these events, of all nodes, by time."""
        found = [r for records in self.journals.values() for r in records if r.event in wanted]
        return sorted(found, key=lambda record: record.t_ns)
