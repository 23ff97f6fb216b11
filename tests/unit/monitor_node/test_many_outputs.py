"""Plants with any number of outputs: the default charts watch them, and a chart that cannot be made is named."""

import msgspec
import numpy as np
import pytest

from monitor_node.config import ChartName, MonitorConfig
from monitor_node.core import Monitor
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, ChartPoint, Quality, Sample
from reactorwatch.errors import InputError

from .samples import Rows

ROW_NS = 6 * 10**9


def plant(outputs: int, rows: int, seed: int = 1) -> Rows:
    """A moving input, and so many lags of it with noise; shape (1 + outputs, rows)."""
    generator = np.random.default_rng(seed)
    u = np.repeat(generator.normal(size=rows // 10 + 1), 10)[:rows]
    values = np.empty((1 + outputs, rows))
    values[0] = u
    gain, state = generator.normal(size=outputs), np.zeros(outputs)
    for row in range(rows):
        values[1:, row] = state + 0.3 * generator.normal(size=outputs)
        state = 0.8 * state + 0.2 * gain * u[row]
    return values


def config_of(
    outputs: int, training_rows: int, charts: tuple[ChartName, ...] = ("shewhart", "ewma", "mewma")
) -> MonitorConfig:
    return MonitorConfig(
        inputs=("u",),
        outputs=tuple(f"y{number}" for number in range(outputs)),
        training_min=training_rows * 0.1,
        charts=charts,
        isolation=False,
        priorities={},
        smallest_sd={},
    )


def watch(monitor: Monitor, values: Rows, first: int = 0, row_ns: int = ROW_NS) -> list[Publication]:
    """Let a monitor watch rows; what it says."""
    said: list[Publication] = []
    names = monitor.config.signals
    for row in range(first, values.shape[1]):
        for name, value in zip(names, values[:, row].tolist(), strict=True):
            if np.isnan(value):
                continue
            message = Sample(time_ns=row * row_ns, sequence=row, value=value, quality=Quality.QUALITY_GOOD)
            said += monitor.on_sample(name, message, 0)
    return said


def training_notes(monitor: Monitor) -> list[str]:
    """Notes of the training; others are of inputs beyond it, and of the promise after few moves of the input."""
    notes, few_moves = monitor.notes, "training: the training moved the plant too little"
    expected = ("training: ", "promise: ", "rows are not judged while u is beyond its range")
    assert all(note.startswith(expected) for note in notes)
    return [note for note in notes if note.startswith("training: ") and not note.startswith(few_moves)]


def raised(said: list[Publication]) -> list[str]:
    return [item.message.alarm for item in said if isinstance(item.message, Alarm) and item.message.event == "raised"]


@pytest.mark.parametrize(
    ("outputs", "training_rows"), [(1, 60), (2, 60), (5, 200), (6, 80), (8, 100), (14, 150), (30, 150), (46, 150)]
)
def test_the_default_charts_watch_any_number_of_outputs(outputs: int, training_rows: int) -> None:
    """A fault in the last output is seen, and by the chart of all outputs too where there is one."""
    monitor = Monitor(config_of(outputs, training_rows), 0, points=False)
    values = plant(outputs, training_rows + 120)
    values[-1, training_rows + 60 :] += 6.0
    said = watch(monitor, values)
    assert monitor.phase == "watching"
    assert monitor.memory.watching_since_ns == max(training_rows, 73) * ROW_NS  # ten rows for each of seven parameters
    assert f"ewma/y{outputs - 1}" in raised(said)
    assert not any(name.endswith("/y0") for name in raised(said) if outputs > 1)
    assert training_notes(monitor) == []
    assert ("mewma/all" in raised(said)) == (outputs > 1)


@pytest.mark.parametrize("charts", [("shewhart", "mewma"), ("ewma", "t2"), ("cusum", "pca_t2", "pca_spe")])
def test_a_chart_of_all_outputs_is_left_out_aloud_after_a_training_with_too_few_rows(
    charts: tuple[ChartName, ...],
) -> None:
    """45 outputs in 80 rows; the budget goes to the other charts, and a stored state knows which these are."""
    config = config_of(45, 80, charts)
    monitor, again = Monitor(config, 0), Monitor(config, 0)
    values = plant(45, 130)
    said = watch(monitor, values[:, :110])
    for name in charts[1:]:
        (note,) = (note for note in monitor.notes if f"{name}/all is left out" in note)
        assert note.endswith("rows in which all 45 outputs could be learned from, 90 are needed")
    points = [item.key for item in said if isinstance(item.message, ChartPoint)]
    assert any(f"/{charts[0]}/" in key for key in points)
    assert not any(key.endswith("/all") for key in points)
    again.from_bytes(monitor.to_bytes())
    assert again.pipeline.baselines.expected_false_alarms == monitor.pipeline.baselines.expected_false_alarms > 0.0
    assert watch(again, values, 110) == watch(monitor, values, 110)


def test_outputs_of_which_one_follows_from_the_others_have_no_chart_of_all() -> None:
    """The same sensor under two names: the charts of each output go on."""
    values = plant(3, 300)
    values[3] = values[2]
    monitor = Monitor(config_of(3, 200), 0, points=False)
    watch(monitor, values)
    assert monitor.phase == "watching"
    assert training_notes(monitor) == [
        "training: mewma/all is left out: one of the outputs y1, y2 follows from the others",
    ]


@pytest.mark.parametrize(("outputs", "period_s"), [(10, 1.0), (2, 0.001), (52, 0.1), (1, 86_400.0), (2, 6e5), (2, 6.0)])
def test_the_default_promise_is_refused_at_no_period_and_the_promise_is_published(
    outputs: int, period_s: float
) -> None:
    config = msgspec.structs.replace(config_of(outputs, 10), training_min=min(150 * period_s / 60, 1e6))
    monitor = Monitor(config, 0, points=False)
    watch(monitor, plant(outputs, 200), row_ns=round(period_s * 1e9))
    assert monitor.phase == "watching"
    alarms = 5 * outputs + (outputs > 1)
    promised = max(min(1.0, 300.0 / period_s), 30 * 86_400 / period_s * alarms / 1e8)
    assert monitor.memory.watching_since_ns is not None
    days = 200 * period_s / 86_400 - monitor.memory.watching_since_ns / 86_400e9
    assert monitor.pipeline.baselines.expected_false_alarms == pytest.approx(promised * days / 30)
    told = (
        f"training: {promised:.3g} false alarms in 30 days are promised instead of 1: that is the nearest"
        if promised > 1.0
        else "training: 1 false alarm in 8,640 rows is promised, 1 in "
    )
    assert [note.startswith(told) for note in monitor.notes] == ([True] if promised != 1.0 else [])


@pytest.mark.parametrize("asked", [None, 0.5])
def test_rows_of_a_day_have_the_charts_of_rows_of_five_minutes_unless_another_number_is_asked(
    asked: float | None,
) -> None:
    values = plant(2, 300)
    values[0, 250:] += 2.0
    raised: dict[float, list[int]] = {}
    for period_s in (300.0, 86_400.0):
        config = msgspec.structs.replace(config_of(2, 10), training_min=150 * period_s / 60)
        monitor = Monitor(msgspec.structs.replace(config, false_alarms_per_30_days=asked), 0, points=False)
        said = watch(monitor, values, row_ns=round(period_s * 1e9))
        alarms = [item.message for item in said if isinstance(item.message, Alarm)]
        raised[period_s] = [round(item.time_ns / period_s / 1e9) for item in alarms if item.event == "raised"]
        assert monitor.promise is not None
        assert (" rows)" in monitor.promise.text) == (period_s > 300.0)
    same = raised[300.0] == raised[86_400.0]
    assert same == (asked is None)
    assert raised[300.0]


def test_a_promise_that_is_asked_for_and_cannot_be_kept_is_refused_with_the_range_and_the_cure() -> None:
    config = msgspec.structs.replace(config_of(10, 10), training_min=2.5, false_alarms_per_30_days=1.0)
    text = r"must be in \[1.1, 2.1e\+06\] for 41 alarms .* got 1; set it within that range, or leave it out"
    with pytest.raises(InputError, match=text):
        watch(Monitor(config, 0, points=False), plant(10, 160), row_ns=10**9)


@pytest.mark.parametrize("charts", [("shewhart", "ewma", "mewma"), ("cusum",), ("t2", "parameters")])
@pytest.mark.parametrize(("outputs", "period_s"), [(10, 1.0), (2, 0.01), (1, 6000.0)])
@pytest.mark.parametrize("bound", [0, 1])
def test_a_promise_that_cannot_be_kept_is_refused_once_the_period_of_the_rows_is_known(
    outputs: int, period_s: float, charts: tuple[ChartName, ...], bound: int
) -> None:
    """Not when the training ends, a thousand rows later; the nearest number that can be kept is not refused."""
    names = len(charts) * outputs if "t2" not in charts else (outputs > 1) + outputs
    alarms = names + 2 * outputs if "mewma" not in charts else 4 * outputs + (outputs > 1)
    nearest = 30 * 86_400 / period_s * alarms / (1e8, 50.0)[bound]
    values = plant(outputs, 40)
    for factor, is_kept in ((0.9, bound == 1), (1.1, bound == 0)):
        asked = nearest * factor
        if not 1e-3 <= asked <= 1e6:
            continue
        settings = config_of(outputs, 10, charts)
        config = msgspec.structs.replace(
            settings, training_min=1000 * period_s / 60, false_alarms_per_30_days=asked, snapshot_min=1e6
        )
        monitor = Monitor(config, 0, points=False)
        if is_kept:
            watch(monitor, values, row_ns=round(period_s * 1e9))
            continue
        with pytest.raises(InputError, match=f"for {alarms} alarms and rows every"):
            watch(monitor, values, row_ns=round(period_s * 1e9))
        assert monitor.rows <= 34


def test_a_promise_that_tests_of_steps_would_make_impossible_is_kept_without_them() -> None:
    """1.1 can be kept for the 41 alarms of ten outputs at 1 Hz, and not for 51."""
    config = msgspec.structs.replace(config_of(10, 10), training_min=2.5, false_alarms_per_30_days=1.1)
    monitor = Monitor(config, 0, points=False)
    watch(monitor, plant(10, 200), row_ns=10**9)
    assert monitor.phase == "watching"
    assert [note for note in monitor.notes if "lasting steps are not tested for" in note]
