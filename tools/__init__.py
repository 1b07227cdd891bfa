"""Programs for people: one file per word of the `caneflow` command, which loads them by name."""
