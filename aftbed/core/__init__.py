"""The vocabulary: bricks, messages, wire, graph, journal, errors. Pure: no clock, no socket."""
