"""Isolation of the likely cause after an alarm."""
