"""Search for the hypothesis that fits a record best."""
