"""Sentences of results and alarms, for the terminal, pages, notebooks, logs and the bus alike."""
