"""The compiled step of a row is the same machine code for plants of any size."""

import reactorwatch as rw
from monitor_node.watch import row_step
from reactorwatch.cli.example import make_example


def watch(name: str) -> None:
    record, _, _ = make_example(name, 3)
    result = rw.backtest(record, process="cstr" if name == "leak" else name, charts=("shewhart", "ewma"))
    assert result.samples > 2000


def test_it_is_compiled_once_for_any_number_of_inputs_outputs_and_alarms() -> None:
    watch("leak")
    compiled = set(row_step.step.signatures)  # type: ignore[attr-defined]
    watch("cascaded_tanks")
    watch("three_tanks")
    assert set(row_step.step.signatures) == compiled  # type: ignore[attr-defined]
