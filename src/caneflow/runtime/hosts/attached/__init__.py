"""Tools that join a running flow."""
