"""What devices say: bytes in, records out, and back. No I/O, no clock."""
