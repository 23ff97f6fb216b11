"""State of a monitor as one structure, and its seal."""
