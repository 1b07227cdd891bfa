"""Programs that turn samples into samples: one file each. Nothing imports them but their own tests."""
