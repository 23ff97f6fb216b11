"""The monitor's state as one structure, and its seal."""
