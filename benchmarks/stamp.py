"""Stamp of a measured page: the day and the commit, so that a reader sees how old its numbers are."""

import subprocess
from datetime import UTC, datetime
from pathlib import Path


def stamp() -> str:
    """One sentence with today's date and the commit of the source tree."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return f"Measured on {datetime.now(UTC):%Y-%m-%d} with commit {commit.strip()}."
