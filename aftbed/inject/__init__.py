"""Faults: the words for them, and (in the runtime) the few places that act them out."""
