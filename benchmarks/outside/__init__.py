"""Public benchmarks that this project did not make, scored by their own rules beside methods of others.

Each file is one benchmark on a folder of its data, which is not part of this project: `make outside DATA=FOLDER`.
Whatever is scored comes from commands that any user can run. A benchmark whose data are not in the folder is left out,
and the table says so.
"""
