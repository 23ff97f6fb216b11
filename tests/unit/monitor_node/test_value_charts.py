"""Charts of the values of all signals, which the settings name, run in the monitor."""

from typing import Any

import numpy as np
import pytest

from monitor_node.core import Monitor

from .test_many_outputs import watch
from .test_many_signals import NAMES, TRAINING, plant, raised, settings

CHARTS: dict[str, dict[str, Any]] = {
    "cva_residual": {},
    "pls": {"pls_quality": ("y9",)},
    "multiple_pca": {},
    "multiway_pca": {"multiway_pca_progress": ("y0",)},
}
"""Charts of values, with the settings that they need."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name == "multiple_pca" else []) for name in CHARTS]
)
def test_a_chart_of_values_raises_its_alarm_and_resumes_bit_for_bit(name: str) -> None:
    """Stored in the middle of the watch; a signal is missing at times."""
    values = plant(TRAINING + 200, TRAINING + 50, 3)
    values[3, TRAINING + 50 :] += 5.0 * values[3, :TRAINING].std()
    values[5, TRAINING + 3 :: 7] = np.nan
    if name == "multiway_pca":
        values[0] = np.arange(values.shape[1]) % 12
    config = settings(charts=(name,), **CHARTS[name])
    whole, first, second = (Monitor(config, 0) for _ in range(3))
    said = watch(whole, values)
    alarms = [alarm for alarm in raised(said) if alarm.alarm == f"{name}/all"]
    assert alarms
    assert "y3" in [item.signal for item in alarms[0].contributions[:3]]
    assert "y3" in alarms[0].text
    before = watch(first, values[:, : TRAINING + 80])
    second.from_bytes(first.to_bytes())
    assert before + watch(second, values, TRAINING + 80) == said
    assert second.pipeline.baselines.expected_false_alarms == whole.pipeline.baselines.expected_false_alarms > 0.0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"charts": ("pls",)}, "the chart pls needs pls_quality, got none; name at most 20 of"),
        ({"charts": ("pls",), "pls_quality": ("z",)}, r"pls_quality must be at most 20 of .* got \('z',\)"),
        ({"pls_quality": ("y1", "y1")}, "pls_quality must be at most 20 of .* each once"),
    ],
)
def test_signals_that_a_chart_needs_are_checked(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        settings(**changed)


def test_a_quality_that_does_not_vary_leaves_the_chart_out_with_the_reason() -> None:
    values = plant(TRAINING + 20)
    values[9] = 1.0
    monitor = Monitor(settings(charts=("residual_space", "pls"), pls_quality=(NAMES[9],)), 0)
    watch(monitor, values)
    assert any("pls/all is left out: pls_quality names y9, which does not vary" in note for note in monitor.notes)
