"""Localisation of a deviation that no known effect explains."""
