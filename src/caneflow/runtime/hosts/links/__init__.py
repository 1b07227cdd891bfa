"""Zenoh sessions, who may do what on them, and certificates."""
