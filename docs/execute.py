"""Execute the notebooks of `examples/` into `build/examples/`, where the site finds them with their figures."""

import os
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
EXECUTED = ROOT / "build" / "examples"
LONGEST_S = 600
"""Seconds that a cell may take."""


def main() -> None:
    """Execute the notebooks that are named, or all of them."""
    named = sys.argv[1:]
    EXECUTED.mkdir(parents=True, exist_ok=True)
    bin_folder = str(Path(sys.executable).parent)
    os.environ["PATH"] = os.pathsep.join([bin_folder, os.environ.get("PATH", "")])
    for path in sorted((ROOT / "examples").glob("*.ipynb")):
        if named and path.stem not in named:
            continue
        notebook = nbformat.read(path, as_version=4)
        with tempfile.TemporaryDirectory() as folder:
            client = NotebookClient(notebook, timeout=LONGEST_S, resources={"metadata": {"path": folder}})
            client.execute()
        nbformat.write(notebook, EXECUTED / path.name)
        sys.stdout.write(f"executed {path.name}\n")


if __name__ == "__main__":
    main()
