"""One node on no host in particular: its streams in event-time order, its operator, its snapshots."""
