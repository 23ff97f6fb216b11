"""Fits of one explanation to a record: its sizes, times and noise."""
