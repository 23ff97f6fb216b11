"""Explanations of a record by a plant that is its model but for a cause, uncertain parameters and noise."""
