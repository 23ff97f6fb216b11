"""`backtest` says what judged the rows and by which noise levels."""

from pathlib import Path
from typing import Literal

import pytest

from monitor_node.config import MonitorConfig
from monitor_node.replay.backtest import Backtest, run
from reactorwatch.api.backtest_report import backtest_object, backtest_text
from tests.unit.monitor_node.samples import leaking_run, samples


def judged(reference: Literal["auto", "process", "arx"], span_min: float = 115.0) -> Backtest:
    record = samples(*leaking_run(0.0, 1.0, span_min, seed=1))
    return run(record, MonitorConfig(reference=reference, isolation=False))


@pytest.mark.parametrize("reference", ["auto", "process"])
def test_the_equations_are_named_with_the_noise_of_the_sensors_and_states(
    reference: Literal["auto", "process"],
) -> None:
    result = judged(reference)
    found = backtest_object(result, 0)
    assert found["reference"] == "equations"
    assert found["noise_levels"]["sensors"] == {"C": pytest.approx(0.002, rel=0.2), "T": pytest.approx(0.3, rel=0.2)}
    assert set(found["noise_levels"]["states"]) == {"C", "T"}
    assert "judged by the equations, with noise of the sensors (standard deviation) C 0.00" in backtest_text(
        result, 0, Path("run.csv")
    )


def test_identified_models_are_named_and_have_no_noise_levels() -> None:
    result = judged("arx")
    found = backtest_object(result, 0)
    assert (found["reference"], found["noise_levels"]) == ("arx", None)
    assert "judged by identified models (ARX)" in backtest_text(result, 0, Path("run.csv"))


def test_a_record_that_was_not_judged_names_nothing() -> None:
    result = judged("auto", 20.0)
    found = backtest_object(result, 0)
    assert (found["reference"], found["noise_levels"]) == (None, None)
    assert "judged by" not in backtest_text(result, 0, Path("run.csv"))
