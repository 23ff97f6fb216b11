"""Models of a monitor have the dead times that its training shows, or those that its settings state."""

import numpy as np
import pytest
from scipy.signal import lfilter

from monitor_node.config import WITHOUT_EQUATIONS, MonitorConfig, ReferenceName
from monitor_node.core import Monitor
from reactorwatch.arrays import Array

from ..samples import feed_row

ROWS, SECOND_NS = 1100, 10**9


def rows_of_plant(*delays: int) -> Array:
    """Rows of first-order responses to inputs that step, each after its dead time, with noise: inputs, then output."""
    rng = np.random.default_rng(52)
    inputs = [np.repeat(rng.standard_normal(ROWS), rng.geometric(0.05, ROWS))[:ROWS] for _ in delays]
    y = 20.0 + 0.05 * rng.standard_normal(ROWS)
    for u, delay in zip(inputs, delays, strict=True):
        y[delay:] += lfilter([0.2], [1.0, -0.8], u)[:-delay]
    return np.column_stack([*inputs, y])


def config_of(reference: ReferenceName, inputs: int, delay: int | dict[str, int] | None = None) -> MonitorConfig:
    names = tuple(f"u{i + 1}" for i in range(inputs))
    return MonitorConfig(
        plant="line", inputs=names, outputs=("y",), process=WITHOUT_EQUATIONS, reference=reference, delay=delay
    )


def trained(config: MonitorConfig, rows: Array) -> tuple[Monitor, list[bytes]]:
    """Monitor that was fed all rows, and its states after the last ones."""
    monitor, states = Monitor(config, 0), []
    for k, values in enumerate(rows.tolist()):
        feed_row(monitor, k, k * SECOND_NS, values)
        if k >= ROWS - 5:
            states.append(monitor.to_bytes())
    return monitor, states


@pytest.mark.parametrize(("reference", "delays"), [("arx", (3, 15)), ("black-box", (12,)), ("auto", (3, 15))])
def test_the_training_shows_the_dead_times_and_a_monitor_resumes_with_them(
    reference: ReferenceName, delays: tuple[int, ...]
) -> None:
    config, rows = config_of(reference, len(delays)), rows_of_plant(*delays)
    monitor, states = trained(config, rows)
    found = monitor.pipeline.models.predictors[0].structure.delays
    assert np.max(np.abs(np.subtract(found, delays))) <= 1
    # a black box has one dead time for all inputs
    assert monitor.pipeline.reference == ("arx" if reference == "auto" else reference)
    second = Monitor(config, 0)
    second.from_bytes(states[0])
    second.on_history_end()
    for k in range(ROWS - 4, ROWS):
        feed_row(second, k, k * SECOND_NS, rows[k].tolist())
        assert second.to_bytes() == states[k - ROWS + 5]


def test_a_stated_delay_is_kept_and_is_by_input_where_they_differ() -> None:
    rows = rows_of_plant(3, 15)
    for delay, of_inputs in ((1, (1, 1)), ({"u2": 14, "u1": 3}, (3, 14))):
        monitor, _ = trained(config_of("arx", 2, delay), rows)
        assert monitor.pipeline.models.predictors[0].structure.delays == of_inputs
    with pytest.raises(ValueError, match=r"delay must be 1 to 100 rows of each input, \('u1', 'u2'\), got \{'u1': 3\}"):
        config_of("arx", 2, {"u1": 3})
