"""Standard deviations of parameters are numbers, infinite where the data are uninformative, and never NaN."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from reactorwatch.contract.messages_pb2 import ModelSnapshot
from reactorwatch.identification.linear_model import standard_deviations
from tests.unit.monitor_node.samples import leaking_run, samples

ENTRIES = st.sampled_from([0.0, 1.0, -1.0, 1e-300, 1e150, np.inf, -np.inf, np.nan]) | st.floats(-1e6, 1e6)
N = 3


@settings(max_examples=200)
@given(hnp.arrays(float, (N, N), elements=ENTRIES), hnp.arrays(float, (2, N), elements=st.floats(-1e6, 1e6)))
def test_they_are_never_nan_whatever_the_covariance(covariance: np.ndarray, matrix: np.ndarray) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        for found in (standard_deviations(covariance), standard_deviations(covariance, matrix)):
            assert np.all(found >= 0.0)


def test_of_a_sound_covariance_they_are_the_roots_of_its_diagonal() -> None:
    factor = np.random.default_rng(1).normal(size=(N, N))
    matrix = np.random.default_rng(2).normal(size=(2, N))
    np.testing.assert_allclose(
        standard_deviations(factor @ factor.T, matrix), np.linalg.norm(matrix @ factor, axis=1), rtol=1e-12
    )


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
