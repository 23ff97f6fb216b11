"""Measured records: a run of the plant as columns, and its file formats."""
