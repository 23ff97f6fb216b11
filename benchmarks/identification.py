"""Best model of the DaISy CSTR record by simulation of its held-out half, and the time of the search.

ARX and output-error models of orders 1 to 3, and the neural predictor where scikit-learn is installed, of C and T. The
record is not part of the repository: name the folder that holds data/daisy_cstr.csv in REACTORWATCH_SHARED.
"""

import importlib.util
import os
from pathlib import Path
from time import perf_counter

import numpy as np

from benchmarks.study_figures.neural import Neural
from reactorwatch.identification.selection import LINEAR_FITS, select
from reactorwatch.identification.structure import Structure


def main() -> None:
    """Measure and print."""
    beside_repository = Path(__file__).resolve().parents[2] / "shared"
    file = Path(os.environ.get("REACTORWATCH_SHARED", beside_repository)) / "data" / "daisy_cstr.csv"
    if not file.is_file():
        print(f"skipped: no DaISy record at {file}")
        return
    time, qc, *outputs = np.loadtxt(file, delimiter=",", skiprows=1).T
    fits = dict(LINEAR_FITS)
    if importlib.util.find_spec("sklearn") is not None:
        fits["neural"] = Neural().fit
    for fit in LINEAR_FITS.values():
        fit(Structure.of_order(1), qc[:200], outputs[0][:200])  # compiles, or loads what was compiled
    for name, output in zip("CT", outputs, strict=True):
        selection = select(qc, output, time, fits)
        print(f"{name}\n{selection.table()}\n{selection.reason}")
        for family, fit in fits.items():
            start = perf_counter()
            fit(Structure.of_order(3), qc[:3750], output[:3750], time[:3750])
            print(f"  fitting {family} of order 3 to 3,750 rows: {1e3 * (perf_counter() - start):.0f} ms")


if __name__ == "__main__":
    main()
