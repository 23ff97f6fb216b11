"""The figures of the work that this project starts from, made by this software, and a page of them: `make reproduce`.

A figure is a line in `catalogue.FIGURES` and a function that draws it and returns what it found; what it found is
computed in that run, never typed in.
"""
