"""Dashboards: what panels describe, drawn by Rerun into a file, a picture or a viewer.

No other folder imports rerun, which an image of nodes that never draw is without.
"""

from importlib.util import find_spec

from reactorwatch.errors import InputError

if find_spec("rerun") is None:
    raise InputError("dashboards need rerun-sdk, which is not installed here: pip install rerun-sdk")
