"""Regressors from a stream are those from the record, whatever is missing."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor_node.learn.arx import LaggedRows
from reactorwatch.identification.data import rows_of
from reactorwatch.identification.structure import Structure

PERIOD_NS = 100


@settings(max_examples=300)
@given(st.data())
def test_stream_and_record_agree(data: st.DataObject) -> None:
    """Random structures, missing values and gaps: the same rows, the same numbers."""
    small = st.integers(1, 3)
    delays = tuple(data.draw(st.lists(small, min_size=1, max_size=2)))
    structure = Structure(
        data.draw(small), data.draw(small), delays, inputs=len(delays), offset=data.draw(st.booleans())
    )
    count = data.draw(st.integers(5, 40))
    rng = np.random.default_rng(data.draw(st.integers(0, 10_000)))
    u, y = rng.standard_normal((count, structure.inputs)), rng.standard_normal((count, 1))
    for signals in (u, y):
        signals[rng.random(signals.shape) < data.draw(st.sampled_from([0.0, 0.1]))] = np.nan
    intervals = np.where(rng.random(count) < data.draw(st.sampled_from([0.0, 0.15])), 3 * PERIOD_NS, PERIOD_NS)
    # The record takes the median interval for the period; the stream restarts at a gap.
    intervals[: count // 2 + 1] = PERIOD_NS
    time_ns = np.cumsum(intervals)

    record = rows_of(structure, u, y, time_ns)
    lagged = LaggedRows(structure)
    stream = {}
    for k in range(count):
        if intervals[k] > PERIOD_NS:
            lagged.restart()
        regressor = lagged.update(u[k].tolist(), float(y[k, 0]))
        if regressor is not None:
            stream[k] = regressor
    assert list(stream) == record.position.tolist()
    for k, regressor in zip(record.position, record.regressors, strict=True):
        np.testing.assert_array_equal(stream[int(k)], regressor)
