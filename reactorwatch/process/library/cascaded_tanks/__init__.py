"""Two tanks, one above the other."""
