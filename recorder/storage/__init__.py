"""Recordings on disk: MCAP files, their parts, their repair."""
