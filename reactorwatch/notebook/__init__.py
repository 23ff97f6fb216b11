"""Results in a notebook: tables, data frames and figures; pandas and matplotlib are optional."""
