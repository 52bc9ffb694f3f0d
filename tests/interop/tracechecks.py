"""What a trace viewer relies on, as a checker; every test of a trace goes through it."""

from collections import defaultdict
from itertools import pairwise
from typing import Any

Event = dict[str, Any]


def problems(events: list[Event]) -> list[str]:
    """Every way in which `events` are no trace that a viewer shows as it is meant."""
    tracks: defaultdict[tuple[int, int], list[Event]] = defaultdict(list)
    for event in events:
        if event["ph"] != "M":
            tracks[event["pid"], event["tid"]].append(event)
    found = [f"track {t} has no name" for t in tracks if t not in _named(events)]
    for track, its in tracks.items():
        found += [
            f"track {track}: {later['name']} at {later['ts']} is behind {one['ts']}"
            for one, later in pairwise(its)
            if later["ts"] < one["ts"]
        ]
        found += _nesting([event for event in its if event["ph"] == "X"])
    return found + _flows(events, tracks) + _asynchronous(events)


def _named(events: list[Event]) -> set[tuple[int, int]]:
    processes = {e["pid"] for e in events if e["name"] == "process_name"}
    return {(e["pid"], e["tid"]) for e in events if e["name"] == "thread_name" and e["pid"] in processes}


def _nesting(slices: list[Event]) -> list[str]:
    found, open_until = [], 0.0
    for one in slices:
        if one["dur"] < 0:
            found.append(f"{one['name']} at {one['ts']} ends before it begins")
        if one["ts"] < open_until - 1e-6:
            found.append(f"{one['name']} at {one['ts']} begins within the one before, until {open_until}")
        open_until = one["ts"] + one["dur"]
    return found


def _flows(events: list[Event], tracks: dict[tuple[int, int], list[Event]]) -> list[str]:
    found = []
    starts = {e["id"]: e for e in events if e["ph"] == "s"}
    ends = {e["id"]: e for e in events if e["ph"] == "f"}
    if len(starts) != sum(e["ph"] == "s" for e in events) or len(ends) != sum(e["ph"] == "f" for e in events):
        found.append("two arrows have one number")
    found += [f"arrow {number} has one end only" for number in starts.keys() ^ ends.keys()]
    for number in starts.keys() & ends.keys():
        start, end = starts[number], ends[number]
        if end["ts"] < start["ts"]:
            found.append(f"arrow {number} goes back in time")
        if (start["cat"], start["name"]) != (end["cat"], end["name"]):
            found.append(f"arrow {number} changes its name")
    bound = {track: {e["ts"] for e in its if e["ph"] == "X"} for track, its in tracks.items()}
    for one in [*starts.values(), *ends.values()]:
        if one["ts"] not in bound[one["pid"], one["tid"]]:
            found.append(f"arrow {one['id']} is bound to no slice")
    return found


def _asynchronous(events: list[Event]) -> list[str]:
    found = []
    begun: dict[tuple[str, int], float] = {}
    for event in events:
        key = (event.get("cat", ""), event.get("id", 0))
        if event["ph"] == "b":
            begun[key] = event["ts"]
        elif event["ph"] == "e" and begun.pop(key, event["ts"] + 1) > event["ts"]:
            found.append(f"{event['name']} ends and was not begun")
    return found + [f"{cat} {number} never ends" for cat, number in begun]
