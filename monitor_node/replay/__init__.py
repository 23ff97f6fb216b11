"""Records and recordings through the monitor again: back-test and verification."""
