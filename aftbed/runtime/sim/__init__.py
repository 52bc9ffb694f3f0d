"""The executive support in virtual time: one process, one seed."""
