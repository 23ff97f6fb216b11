"""An alarm ends when the plant is back, not when its predictor has followed."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import lfilter

import reactorwatch as rw
from benchmarks.harness.plants import INPUTS, KINDS, Kind, simulate
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Publication
from reactorwatch.records.record import Record

from ..samples import feed_row

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


def biased_reactor(kind: Kind, seed: int, size_sd: float) -> Record:
    """A record of the reactor in which the temperature is off by a number of standard deviations for some rows."""
    record = simulate(kind, INPUTS["a new flow in 90 to 111 each minute"], seed)
    rows = np.arange(ROWS)
    columns = {name: values[:ROWS].copy() for name, values in record.columns.items()}
    columns["T"] += size_sd * 0.3 * ((rows >= ONSET) & (rows < BACK))
    return Record(record.time_min[:ROWS], columns, "biased")


def alarm_rows(record: Record, *, diagnose_training: bool) -> Array:
    """Flags of the rows in alarm."""
    found = rw.backtest(record, isolation=False, training_rows=TRAINING, diagnose_training=diagnose_training)
    assert found.reference == "equations"
    flags = np.zeros(record.time_min.size, dtype=bool)
    for alarm in found.alarms:
        end_min = np.inf if alarm.cleared_min is None else alarm.cleared_min
        flags |= (record.time_min > alarm.raised_min - 0.05) & (record.time_min < end_min - 0.05)
    return flags


def test_after_a_large_fault_the_equations_go_on_as_if_they_had_not_followed_it() -> None:
    """A chart with a long memory would otherwise be out for as long as it takes to forget."""
    flags = alarm_rows(biased_reactor(Kind("as the model"), 1, 14.0), diagnose_training=False)
    assert np.mean(flags[ONSET:BACK]) > 0.98
    assert not flags[BACK + 60 :].any()


def test_after_a_gap_in_a_fault_its_alarm_still_ends_when_the_plant_is_back() -> None:
    """The state of the filter after the gap is that of the fault, and no free run starts from it."""
    record = biased_reactor(Kind("as the model"), 1, 14.0)
    kept = (np.arange(ROWS) < ONSET + 100) | (np.arange(ROWS) >= ONSET + 250)
    columns = {name: values[kept] for name, values in record.columns.items()}
    flags = alarm_rows(Record(record.time_min[kept], columns, "gap"), diagnose_training=False)
    assert np.mean(flags[ONSET : ONSET + 100]) > 0.95
    assert not flags[BACK - 150 + 250 :].any()  # 150 rows are missing, and the charts take 190 to forget the fault


@pytest.mark.slow
def test_a_fault_that_a_wandering_state_takes_over_is_one_standing_alarm() -> None:
    wandering = next(kind for kind in KINDS if kind.name == "feed that wanders")
    flags = alarm_rows(biased_reactor(wandering, 2, 14.0), diagnose_training=True)
    assert np.mean(flags[ONSET:BACK]) > 0.98
    assert not flags[BACK + 60 :].any()


def test_a_monitor_with_equations_resumes_bit_for_bit_in_a_fault_and_after_it() -> None:
    record = biased_reactor(Kind("as the model"), 2, 14.0)
    config = MonitorConfig(training_rows=TRAINING, isolation=False, diagnose_training=False)
    rows = np.column_stack([record.columns[name] for name in config.signals]).tolist()
    monitors = [Monitor(config, 0), Monitor(config, 0)]
    said: tuple[list[Publication], list[Publication]] = [], []
    for k, values in enumerate(rows[: BACK + 100]):
        if k in (ONSET - 3, ONSET + 40, BACK + 10):
            stored = monitors[1].to_bytes()
            monitors[1] = Monitor(config, 0)
            monitors[1].from_bytes(stored)
        for monitor, messages in zip(monitors, said, strict=True):
            messages += feed_row(monitor, k, round(k * 6e9), values)
    assert said[0] == said[1]
    assert monitors[0].to_bytes() == monitors[1].to_bytes()
