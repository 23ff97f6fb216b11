"""An alarm ends when the plant is back, not when its predictor has followed."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import lfilter

import reactorwatch as rw
from reactorwatch.arrays import Array
from reactorwatch.records.record import Record

TRAINING, ONSET, BACK, ROWS = 1000, 1200, 1700, 2000


def wanders(seed: int) -> dict[str, Array]:
    """A signal that remembers, without inputs."""
    rng = np.random.default_rng(seed)
    values = lfilter([1.0], [1.0, -0.9], rng.standard_normal(ROWS + 500))[500:] * np.sqrt(1.0 - 0.9**2)
    return {"y": values + 0.3 * rng.standard_normal(ROWS)}


def follows_inputs(seed: int) -> dict[str, Array]:
    """An output that follows two inputs, with noise that remembers."""
    rng = np.random.default_rng(seed)
    inputs = np.repeat(rng.uniform(-1.0, 1.0, (ROWS // 40, 2)), 40, axis=0)
    explained = lfilter([0.1], [1.0, -0.9], inputs @ np.array([6.0, 3.0]))
    return {"u": inputs[:, 0], "v": inputs[:, 1], "y": explained + wanders(seed + 100)["y"]}


def in_alarm(columns: dict[str, Array], size: float) -> Array:
    """Flags of the rows in alarm, where `y` is off by `size` for some rows."""
    rows: Array = np.arange(ROWS, dtype=np.float64)
    shown = columns | {"y": columns["y"] + size * ((rows >= ONSET) & (rows < BACK))}
    found = rw.backtest(
        Record(0.1 * rows, shown, "step"),
        inputs=tuple(name for name in shown if name != "y"),
        outputs=("y",),
        reference="arx",
        training_rows=TRAINING,
    )
    flags = np.zeros(ROWS, dtype=bool)
    for alarm in found.alarms:
        end_min = np.inf if alarm.cleared_min is None else alarm.cleared_min
        flags |= (0.1 * rows > alarm.raised_min - 0.05) & (0.1 * rows < end_min - 0.05)
    return flags


@pytest.mark.parametrize("plant", [wanders, follows_inputs])
def test_a_step_that_the_model_follows_is_one_standing_alarm_until_the_plant_is_back(
    plant: Callable[[int], dict[str, Array]],
) -> None:
    for seed in (1, 2, 5):
        flags = in_alarm(plant(seed), 6.0)
        assert np.mean(flags[ONSET:BACK]) > 0.98, seed
        assert not flags[:ONSET].any()
        assert not flags[BACK + 100 :].any()


def test_a_lone_outlier_of_the_process_is_no_standing_alarm() -> None:
    """A kick after which the signal returns by itself is over when the signal is back."""
    columns = wanders(4)
    kick = np.zeros(ROWS)
    kick[ONSET] = 6.0
    columns["y"] = columns["y"] + lfilter([1.0], [1.0, -0.9], kick)
    flags = in_alarm(columns, 0.0)
    assert flags[ONSET : ONSET + 40].any()
    assert not flags[ONSET + 80 :].any()
