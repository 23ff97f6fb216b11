"""A recording's messages as columns of numbers, for drawing."""
