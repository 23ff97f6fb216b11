"""The recursive ARX model judges where it is chosen, and predicts beside another reference."""

import numpy as np
import pytest

from monitor_node.config import ReferenceName
from monitor_node.core import Monitor
from monitor_node.learn.references import COPY_ROWS
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Estimate, ModelSnapshot
from tests.exchanger import config_of, random_exchanger, simulate

from .samples import feed_row

ROWS, SECOND_NS = 1600, 10**9


@pytest.fixture(scope="module")
def plant() -> tuple[Array, Array]:
    rng = np.random.default_rng(1)
    return simulate(random_exchanger(rng), ROWS, rng)


def take(monitor: Monitor, row: int, values: tuple[float, float]) -> list[Publication]:
    return feed_row(monitor, row, row * SECOND_NS, values)


def adaptive(monitor: Monitor) -> ModelSnapshot:
    snapshots = [item.message for item in monitor.pipeline.snapshots(0)]
    models = [item for item in snapshots if isinstance(item, ModelSnapshot) and item.structure == "arx"]
    (found,) = [item for item in models if not item.held]
    return found


@pytest.mark.parametrize(("reference", "end"), [("arx", "th"), ("black-box", "th/arx")])
def test_its_prediction_is_that_of_its_newest_parameters(
    plant: tuple[Array, Array], reference: ReferenceName, end: str
) -> None:
    """By hand: y[k] = a1 y[k-1] + ... + b1 u[k-1] + ... + c, with the parameters that were learned before the row."""
    flow, measured = plant
    monitor, compared = Monitor(config_of(reference), 0), 0
    for k, values in enumerate(zip(flow.tolist(), measured.tolist(), strict=True)):
        known, order = {}, 0
        if k > 1050 and k % 50 == 0:
            model = adaptive(monitor)
            known, order = {item.name: item.value for item in model.parameters}, model.order
        found = {item.key: item.message for item in take(monitor, k, values)}
        estimate = found.get(f"reactor/exchanger/estimate/{end}")
        if known and estimate is not None:
            assert isinstance(estimate, Estimate)
            lags = range(1, order + 1)
            expected = known["c"] + sum(known[f"a{i}"] * measured[k - i] + known[f"b{i}"] * flow[k - i] for i in lags)
            assert estimate.prediction == pytest.approx(expected, abs=1e-6)
            assert estimate.residual == pytest.approx(measured[k] - expected, abs=1e-6)
            compared += 1
    assert compared >= 6
    assert adaptive(monitor).reference == (reference == "arx")
    assert monitor.pipeline.reference == reference


def adapted(monitor: Monitor) -> bytes:
    """Memory of the recursive least squares of the adaptive model."""
    return monitor.pipeline.models.predictors[0].rls.memory.to_bytes()


def test_it_learns_nothing_while_an_alarm_is_active_and_what_it_learned_last_is_taken_back(
    plant: tuple[Array, Array],
) -> None:
    flow, measured = plant
    onset = 1550
    stepped = measured + 3.0 * (np.arange(ROWS) >= onset)
    monitor, history = Monitor(config_of("arx"), 0, points=False), {}
    for k, values in enumerate(zip(flow.tolist(), stepped.tolist(), strict=True)):
        take(monitor, k, values)
        if k >= 1000:
            history[k] = (adapted(monitor), monitor.alarms.has_unexplained)
    first = next(k for k, (_, is_active) in history.items() if is_active)
    assert onset < first < onset + 20
    assert history[first - 1][0] != history[first][0]
    same = [k for k in range(1000, first) if history[k][0] == history[first][0]]
    assert same
    assert first - same[-1] <= 2 * COPY_ROWS
    active = [k for k, (_, is_active) in history.items() if is_active]
    assert len(active) > 5
    assert {history[k][0] for k in active} == {history[first][0]}
    assert history[onset - 1][0] != history[onset - 2][0]


def test_an_outlier_teaches_it_nothing(plant: tuple[Array, Array]) -> None:
    flow, measured = plant
    monitor = Monitor(config_of("arx"), 0, points=False)
    for k, values in enumerate(zip(flow[:1100].tolist(), measured[:1100].tolist(), strict=True)):
        take(monitor, k, values)
    before = adapted(monitor)
    take(monitor, 1100, (float(flow[1100]), float(measured[1100]) + 50.0))
    assert adapted(monitor) == before
