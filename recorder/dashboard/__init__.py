"""Dashboards: what panels describe, drawn by Rerun into a file, a picture or a viewer.

No other folder imports rerun.
"""
