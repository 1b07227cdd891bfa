"""Arrays and numbers in, arrays and numbers out: no I/O, no clock, no messages."""
