"""The CAN bus: frames, logs, DBC, E2E protection, the hub between processes and its clients."""
