"""Programs that bring samples in: one file per device, and one replayer. Only their own tests import them."""
