"""The compiled step of a row is the same machine code for plants of any size."""

import pytest

import reactorwatch as rw
from monitor_node.pipeline import row_step
from plant_node.examples import make_example


@pytest.mark.parametrize("name", ["leak", "cascaded_tanks", "three_tanks"])
def test_it_is_compiled_once_for_any_number_of_inputs_outputs_and_alarms(name: str) -> None:
    record, _ = make_example(name, 3)
    result = rw.backtest(record, process="cstr" if name == "leak" else name, charts=("shewhart", "ewma"))
    assert result.samples > 2000
    assert len(row_step.step.signatures) == 1  # type: ignore[attr-defined]
