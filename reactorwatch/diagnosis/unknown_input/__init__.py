"""Localisation of a deviation that no effect of the catalogue explains."""
