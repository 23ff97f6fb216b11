"""Without equations, whatever input and output a rig has, its training ends without an error of this software."""

import numpy as np
import pytest
from scipy.signal import lfilter

from monitor_node.config import MonitorConfig
from reactorwatch.arrays import Array

from .watching import watched

ROWS, TRAINING = 640, 500
ROW = np.arange(ROWS)
INPUTS = {
    "one pulse": (ROW == 200) * 1.0,
    "a step in the last row of the training": (ROW >= TRAINING - 1) * 1.0,
    "a step in the first row": (ROW >= 1) * 1.0,
    "few steps": (ROW // 170 % 2) * 1.0,
    "a ramp": ROW / 100.0,
    "a sine of hardly any size": 1e-9 * np.sin(ROW),
    "steps of a huge size": 1e9 * (ROW // 50 % 2),
    "gaps": np.where(ROW % 97 < 3, np.nan, (ROW // 60 % 3) * 1.0),
    "a sine": np.sin(ROW / 15.0),
}
OUTPUTS = ("follows", "noise", "constant", "coarse", "without noise")
QUICK = {
    ("one pulse", "constant"),
    ("a step in the last row of the training", "follows"),
    ("few steps", "without noise"),
    ("steps of a huge size", "without noise"),
    ("a step in the first row", "coarse"),
    ("gaps", "follows"),
}


def output(kind: str, u: Array) -> Array:
    """An output of a plant of first order with the gain 5 for an input of the size 1."""
    noise = 0.0 if kind == "without noise" else np.random.default_rng(1).normal(0.0, 0.05, ROWS)
    known = np.nan_to_num(u)
    driven = np.zeros(ROWS) if kind == "noise" else np.concatenate([[0.0], known[:-1] / np.ptp(known)])
    y = lfilter([1.0], [1.0, -0.8], driven + noise)
    if kind == "coarse":
        return np.asarray(np.round(3.0 * y) / 3.0)
    return np.full(ROWS, 3.0) if kind == "constant" else np.asarray(y)


@pytest.mark.parametrize(
    ("moves", "kind"),
    [
        pytest.param(moves, kind, marks=[] if (moves, kind) in QUICK else [pytest.mark.slow])
        for moves in INPUTS
        for kind in OUTPUTS
    ],
)
def test_a_training_ends_without_an_error_of_this_software(moves: str, kind: str) -> None:
    config = MonitorConfig(
        process="",
        inputs=("qc",),
        outputs=("T",),
        priorities={},
        smallest_sd={},
        isolation=False,
        training_min=TRAINING / 10.0,
    )
    values = output(kind, INPUTS[moves])
    run = watched(ROW / 10.0, {"qc": INPUTS[moves], "T": values}, config)
    assert not [note for note in run.monitor.notes if "error of this software" in note]
    varies = np.ptp(values[:TRAINING]) > 0.0
    assert (run.monitor.phase == "watching") == varies
