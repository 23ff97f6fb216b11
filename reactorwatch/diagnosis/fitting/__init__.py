"""Fits of one hypothesis to a record: magnitudes, times and noise."""
