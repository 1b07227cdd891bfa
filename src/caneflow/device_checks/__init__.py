"""What `caneflow doctor --devices` asks each device: one file a driver, and what they share."""
