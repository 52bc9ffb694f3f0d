"""Files that other tools write or read: logs of a CAN bus, MCAP, traces for Perfetto, OpenSCENARIO."""
