"""The limits of the drift are prepared for every memory that the adaptive models may come to have."""

import pytest

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.charts import shift_and_drift as drift
from monitor_node.config import MonitorConfig, ReferenceName
from monitor_node.learn.arx import JUDGING_FORGETTING, arx_structure
from reactorwatch.spc.charts.parameters import adaptive_weight, parameter_limit


@pytest.mark.parametrize(
    ("reference", "memories"),
    [
        ("auto", {0.99, JUDGING_FORGETTING}),
        ("arx", {JUDGING_FORGETTING}),
        ("equations", {0.99}),
        ("black-box", {0.99}),
    ],
)
def test_no_limit_is_computed_after_the_preparation(
    monkeypatch: pytest.MonkeyPatch, reference: ReferenceName, memories: set[float]
) -> None:
    config = MonitorConfig(reference=reference, forgetting=0.99, order=1)
    for _ in drift.preparation(config, wanted=True):
        pass

    def fail(*_: object) -> float:
        raise AssertionError("computed again")

    monkeypatch.setattr("reactorwatch.spc.charts.parameters.mewma_run_length", fail)
    for forgetting in memories:
        assert parameter_limit(1e5, arx_structure(config).parameters, adaptive_weight(forgetting), 500.0, 0.1) > 0.0


def test_nothing_is_prepared_for_a_drift_that_has_no_limit() -> None:
    assert list(drift.preparation(MonitorConfig(), wanted=False)) == []
    with_alarm = MonitorConfig(charts=("ewma", "parameters"))
    assert drift.DriftWatch(with_alarm, Annunciator(with_alarm), publish=False).wanted
    assert next(drift.preparation(with_alarm, wanted=False), "nothing") is None
