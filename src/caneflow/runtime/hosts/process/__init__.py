"""One process of a flow: its nodes on one Zenoh session."""
