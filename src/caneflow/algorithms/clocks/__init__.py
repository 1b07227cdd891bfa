"""What one clock says of another."""
