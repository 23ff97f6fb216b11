"""Replay of records and recordings through the monitor: back-test and verification."""
