"""Starts the processes of a flow, follows, restarts and ends them."""
