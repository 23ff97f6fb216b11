"""Measured records: a run of the plant as columns, from wherever it came."""
