"""The charts of a plant together: each finds its kind of fault, names the signal, and restarts afterwards."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from monitor_node.config import CHART_SIGNALS, ChartName, MonitorConfig
from reactorwatch.spc.charts.catalogue import CHARTS
from reactorwatch.spc.charts.cusum import CEILING, Cusum

from ..watching import sound_run, watched

AT_MIN, AT = 130.0, 1300


@pytest.mark.parametrize(
    ("chart", "size", "within_min", "alarm"),
    [
        ("shewhart", 2.0, 0.5, "shewhart/T"),
        ("ewma", 0.6, 2.0, "ewma/T"),
        ("cusum", 0.6, 3.0, "cusum/T"),
        ("t2", 2.5, 0.7, "t2/all"),
        ("mewma", 0.6, 4.0, "mewma/all"),
        ("pca_t2", 3.0, 1.0, "pca_t2/all"),
        ("pca_spe", 3.0, 1.0, "pca_spe/all"),
    ],
)
def test_each_chart_alone_finds_a_lasting_shift_of_a_sensor_and_names_the_sensor(
    chart: ChartName, size: float, within_min: float, alarm: str
) -> None:
    """Stage by stage: a compiled step for each set of charts takes seconds."""
    time_min, columns = sound_run(150.0, seed=1)
    columns["T"][AT:] += size
    run = watched(time_min, columns, MonitorConfig(charts=(chart,), isolation=False), compiled=False)
    names = [name for name, _ in run.raised]
    assert alarm in names
    first = next(item for item in run.alarms if item.alarm == alarm)
    assert AT_MIN < first.time_ns / 60e9 <= AT_MIN + within_min
    largest = max(first.contributions, key=lambda item: item.share)
    assert largest.signal == "T" or chart.startswith("pca")
    assert sum(item.share for item in first.contributions) == pytest.approx(1.0)
    assert first.unit == "sd"


@pytest.mark.slow
def test_all_charts_together_are_quiet_on_a_sound_plant_and_share_the_budget() -> None:
    names = tuple(kind.name for kind in CHARTS if kind.name != "parameters")
    signals: dict[str, Any] = {item.key: ("C",) for item in CHART_SIGNALS}
    config = MonitorConfig(charts=names, isolation=False, **signals)
    run = watched(*sound_run(400.0, seed=2), config)
    assert run.raised == []
    alone = watched(*sound_run(110.0, seed=2), MonitorConfig(charts=("shewhart",), isolation=False))
    widths = [watch.points("shewhart/T")[-1].upper_limit for watch in (run, alone)]
    assert widths[0] > widths[1]
    assert run.monitor.pipeline.baselines.expected_false_alarms == pytest.approx(300 / (30 * 24 * 60), rel=0.01)


def test_a_wider_budget_makes_narrower_limits_as_the_run_lengths_require() -> None:
    run = sound_run(110.0, seed=3)
    limits = [
        watched(*run, MonitorConfig(false_alarms_per_30_days=budget, isolation=False)).points("ewma/T")[-1].upper_limit
        for budget in (0.1, 1.0, 30.0, 1000.0)
    ]
    assert limits == sorted(limits, reverse=True)


def test_a_chart_with_a_memory_restarts_when_its_alarm_is_cleared() -> None:
    time_min, columns = sound_run(170.0, seed=4)
    columns["T"][AT : AT + 50] += 1.5
    run = watched(time_min, columns, MonitorConfig(charts=("ewma",), isolation=False))
    cleared = next(item.time_ns for item in run.alarms if item.event == "cleared")
    after = [point for point in run.points("ewma/T") if point.time_ns > cleared]
    assert abs(after[0].statistic) < 0.1 * 3  # one row of weight 0.1 from zero
    assert [event for event in (item.event for item in run.alarms) if event == "raised"] == ["raised"]


def test_a_cusum_stops_at_its_ceiling_and_is_soon_back_after_a_large_change() -> None:
    chart = Cusum(0.0, 1.0, k=0.5, h=5.0)
    seen = [chart.update(10.0) for _ in range(1000)]
    assert max(point.statistic for point in seen) == CEILING * 5.0
    back = next(rows for rows in range(1, 100) if not chart.update(0.0).out)
    assert back == round((CEILING - 1.0) * 5.0 / 0.5)


def test_the_drift_of_the_model_is_published_every_fifty_rows_and_is_an_alarm_only_where_asked_for() -> None:
    time_min, columns = sound_run(300.0, seed=5)
    gain = np.where(time_min < 150.0, 1.0, 1.15)
    centre = columns["T"].mean()
    columns["T"] = centre + gain * (columns["T"] - centre)
    told = watched(time_min, columns, MonitorConfig(isolation=False))
    points = told.points("parameters/T")
    assert {round(b.time_ns / 6e9) - round(a.time_ns / 6e9) for a, b in pairwise(points)} == {50}
    assert not any(point.out for point in points if point.time_ns < 150 * 60e9)
    assert any(point.out for point in points if point.time_ns > 200 * 60e9)
    assert not [name for name, _ in told.raised if name.startswith("parameters")]
    asked = watched(time_min, columns, MonitorConfig(charts=("ewma", "parameters"), isolation=False))
    drift = [item for item in asked.alarms if item.alarm == "parameters/T" and item.event == "raised"]
    assert drift
    assert drift[0].text.startswith("the model of T that adapts has drifted from its reference, most in ")
