"""Where a graph runs: as processes over Zenoh, or all in this process."""
