"""The processes that are shipped, each in a folder: its model and its effects."""
