"""Plants of many signals without equations: the residual space is their chart, and names where a disturbance enters."""

import pickle

import msgspec
import numpy as np
import pytest

from monitor_node.config import CHARTS_OF_DOZENS, CHARTS_OF_MANY, DOZENS, USUAL_CHARTS, DefaultCharts, MonitorConfig
from monitor_node.core import Monitor
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, Incident

from .samples import Rows
from .test_many_outputs import watch

TRAINING, SIGNALS = 200, 10
NAMES = tuple(f"y{i}" for i in range(SIGNALS))


def settings(signals: int = SIGNALS, **changed: object) -> MonitorConfig:
    config = MonitorConfig(
        process="",
        inputs=(),
        outputs=NAMES[:signals],
        training_rows=TRAINING,
        priorities={},
        smallest_sd={},
    )
    return msgspec.structs.replace(config, **changed)


def plant(rows: int, fault_at: int | None = None, faulty: int = 0, seed: int = 1) -> Rows:
    """Signals driven by two slow factors, with noise; a shift of one of them by its standard deviation."""
    rng = np.random.default_rng(seed)
    load, factor = rng.standard_normal((SIGNALS, 2)), np.zeros(2)
    values = np.empty((SIGNALS, rows))
    for row in range(rows):
        factor = 0.9 * factor + rng.standard_normal(2)
        values[:, row] = load @ factor + 0.3 * rng.standard_normal(SIGNALS)
    if fault_at is not None:
        values[faulty, fault_at:] += values[faulty, :TRAINING].std()
    return values


def raised(said: list[Publication]) -> list[Alarm]:
    return [item.message for item in said if isinstance(item.message, Alarm) and item.message.event == "raised"]


@pytest.mark.parametrize(
    ("config", "charts"),
    [
        (settings(), CHARTS_OF_MANY),
        (settings(outputs=tuple(f"y{i}" for i in range(DOZENS))), CHARTS_OF_DOZENS),
        (settings(7), USUAL_CHARTS),
        (settings(7, inputs=("u", "v")), USUAL_CHARTS),
        (settings(process="plant.toml"), USUAL_CHARTS),
        (settings(process="plant.toml", reference="arx"), CHARTS_OF_MANY),
        (settings(charts=("cusum",)), ("cusum",)),
        (MonitorConfig(), USUAL_CHARTS),
        (msgspec.structs.replace(settings(), outputs=("a", "b")), USUAL_CHARTS),
    ],
)
def test_many_signals_without_equations_have_charts_of_their_own_where_none_are_named(
    config: MonitorConfig, charts: tuple[str, ...]
) -> None:
    """So too after another process has got the settings, where signals may be named later."""
    assert config.charts == charts
    sent = pickle.loads(pickle.dumps(config))
    assert sent.charts == charts
    few = msgspec.structs.replace(sent, outputs=("a",), priorities={})
    assert few.charts == (USUAL_CHARTS if isinstance(config.charts, DefaultCharts) else charts)


@pytest.mark.parametrize("faulty", [0, 6])
def test_the_alarm_names_the_signal_at_which_the_disturbance_enters(faulty: int) -> None:
    """In text, contributions and suspects, which other alarms of the incident get, too."""
    monitor = Monitor(settings(), 0, points=False)
    said = watch(monitor, plant(TRAINING + 140, TRAINING + 100, faulty))
    (alarm,) = raised(said)
    assert alarm.alarm == "residual_space/all"
    assert alarm.text.startswith(f"the disturbance enters at y{faulty}: ")
    assert alarm.contributions[0].signal == f"y{faulty}"
    assert sum(item.share for item in alarm.contributions) == pytest.approx(1.0)
    suspected = [item.message for item in said if isinstance(item.message, Incident)]
    assert suspected[-1].suspects[0].cause == f"y{faulty}"
    assert len(suspected[-1].suspects) == 3


@pytest.mark.parametrize("ends", [True, False])
def test_the_end_of_an_anomaly_is_an_event_of_the_same_incident(ends: bool) -> None:
    """Also where the monitor is stored and resumed within the anomaly."""
    values = plant(TRAINING + 240)
    first, end = TRAINING + 60, TRAINING + 160 if ends else TRAINING + 240
    values[2, first:end] += 8.0 * values[2, :TRAINING].std()
    whole = Monitor(settings(), 0)
    said = watch(whole, values)
    changes = [alarm for alarm in raised(said) if alarm.alarm == "change/all"]
    assert len(changes) == ends
    if ends:
        (change,) = changes
        assert change.incident == raised(said)[0].incident == 1
        assert change.text.startswith("the plant moves again: y2 by -")
        assert change.contributions[0].signal == "y2"
    before, after = Monitor(settings(), 0), Monitor(settings(), 0)
    heard = watch(before, values[:, : TRAINING + 150])
    after.from_bytes(before.to_bytes())
    assert heard + watch(after, values, TRAINING + 150) == said


def test_a_monitor_that_resumes_publishes_the_same_bit_for_bit() -> None:
    """Stored before and in the alarm."""
    values = plant(TRAINING + 140, TRAINING + 100)
    whole = Monitor(settings(), 0)
    said = watch(whole, values)
    for stop in (TRAINING + 50, TRAINING + 130):
        first, second = Monitor(settings(), 0), Monitor(settings(), 0)
        before = watch(first, values[:, :stop])
        second.from_bytes(first.to_bytes())
        assert second.pipeline.baselines.expected_false_alarms == first.pipeline.baselines.expected_false_alarms > 0.0
        assert before + watch(second, values, stop) == said


def test_missing_values_neither_blind_the_chart_nor_raise_it() -> None:
    """A third of the rows lack a signal, at times two."""
    values = plant(TRAINING + 240, TRAINING + 200, 3)
    rng = np.random.default_rng(2)
    for row in range(TRAINING, TRAINING + 240):
        if rng.random() < 1 / 3:
            values[rng.integers(4, SIGNALS, 2), row] = np.nan
    alarms = raised(watch(Monitor(settings(), 0, points=False), values, 0))
    joint = [alarm for alarm in alarms if alarm.alarm == "residual_space/all"]
    assert [alarm.contributions[0].signal for alarm in joint] == ["y3"]
    assert joint[0].time_ns > (TRAINING + 200) * 6 * 10**9


def test_lost_rows_do_not_blind_the_chart() -> None:
    """Every third row is lost, so there are never the rows before that the identified models need."""
    values = plant(TRAINING + 240, TRAINING + 150, 2)
    values[:, TRAINING::3] = np.nan
    (alarm,) = raised(watch(Monitor(settings(), 0, points=False), values))
    assert alarm.alarm == "residual_space/all"
    assert alarm.contributions[0].signal == "y2"


def test_after_a_training_too_short_for_the_chart_each_output_has_its_own() -> None:
    """The reason is in the notes, and a stored state knows which charts there are."""
    values = plant(90 + 130)
    values[4, 90 + 100 :] += 20.0
    monitor, resumed = (Monitor(settings(training_rows=90), 0, points=False) for _ in range(2))
    watch(monitor, values[:, :120])
    (note,) = (item for item in monitor.notes if "residual_space/all is left out" in item)
    assert note.endswith("90 rows in which all 10 signals could be learned from, 100 are needed")
    resumed.from_bytes(monitor.to_bytes())
    assert "ewma/y4" in {alarm.alarm for alarm in raised(watch(resumed, values, 120))}
    assert resumed.pipeline.baselines.expected_false_alarms > 0.0
