"""The stirred-tank reactor."""
