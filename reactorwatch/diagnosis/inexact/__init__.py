"""Explanations of a record by a plant that is never quite its model."""
