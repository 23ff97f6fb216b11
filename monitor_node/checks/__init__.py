"""Checks of single signals: no data, stuck values, spikes."""
