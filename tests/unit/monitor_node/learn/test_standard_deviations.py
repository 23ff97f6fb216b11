"""Models of signals that never move have standard deviations that are numbers, or infinite."""

import numpy as np
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from reactorwatch.contract.messages_pb2 import ModelSnapshot
from tests.unit.monitor_node.samples import leaking_run, samples


@pytest.mark.parametrize("held", [("qc",), ("C",), ("qc", "C", "T")], ids="+".join)
@pytest.mark.parametrize("reference", ["process", "arx", "auto"])
def test_models_of_signals_that_never_move_have_no_nan(held: tuple[str, ...], reference: str) -> None:
    time_min, columns = leaking_run(0.0, 1.0, 30.0, seed=1)
    for signal in held:
        columns[signal][:] = columns[signal][0]
    config = MonitorConfig(training_min=10.0, snapshot_min=1.0, reference=reference)  # type: ignore[arg-type]
    monitor, snapshots = Monitor(config, 0), list[ModelSnapshot]()
    for message in samples(time_min, columns):
        snapshots += [i.message for i in monitor.on_message(message, 0) if isinstance(i.message, ModelSnapshot)]
    assert [item for item in snapshots if any(np.isnan(parameter.sd) for parameter in item.parameters)] == []
