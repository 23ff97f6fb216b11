"""Search for the explanation that fits a record best."""
