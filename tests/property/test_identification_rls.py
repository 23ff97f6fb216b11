"""Recursive least squares, whatever comes."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from reactorwatch.identification.rls import RecursiveLeastSquares
from reactorwatch.stored_state import copy_of

N = 4
FORGETTING = st.sampled_from([0.5, 0.9, 0.99, 0.9999, 1.0])
SCALED = st.floats(-10.0, 10.0) | st.sampled_from([0.0, 1.0, 1e-3, 1e-9, 1e-300])
ANY = st.floats(-1e6, 1e6) | st.sampled_from([0.0, 1e-300, 1e-9, -1e9, 9e29, -9e29])


def rows_of(elements: st.SearchStrategy[float]) -> st.SearchStrategy[NDArray[np.float64]]:
    return st.integers(1, 30).flatmap(lambda rows: arrays(np.float64, (rows, N + 1), elements=elements))


@settings(max_examples=300)
@given(rows_of(SCALED), FORGETTING, st.sampled_from([1e-2, 1.0, 1e6]))
def test_scaled_rows_never_take_the_covariance_out_of_its_bounds(
    rows: NDArray[np.float64], forgetting: float, limit: float
) -> None:
    """Eigenvalues in (0, limit], to rounding, after every row."""
    rls = RecursiveLeastSquares(N, forgetting, limit)
    for row in rows:
        rls.update(row[:N], row[N])
        eigenvalues = np.linalg.eigvalsh(rls.covariance)
        assert eigenvalues[-1] <= limit * (1.0 + 1e-6)
        assert np.all(np.diag(rls.covariance) > 0.0)


@settings(max_examples=200)
@given(rows_of(ANY), FORGETTING, st.sampled_from([1e-2, 1e6, None]))
def test_whatever_is_accepted_leaves_finite_numbers(
    rows: NDArray[np.float64], forgetting: float, limit: float | None
) -> None:
    """Rows of any size below 1e30, with a prior and without one."""
    rls = RecursiveLeastSquares(N, forgetting, limit)
    for row in rows:
        said = rls.update(row[:N], row[N])
        assert np.isfinite([said.prediction, said.residual]).all()
        assert said.residual_sd >= 0.0
        assert 0.0 <= said.leverage <= 1.0
    assert np.all(np.isfinite(rls.parameters))
    assert np.all(np.diag(rls.covariance) > 0.0)


@settings(max_examples=200)
@given(rows_of(ANY), FORGETTING, st.data())
def test_stored_at_any_row_it_resumes_with_the_same_bits(
    rows: NDArray[np.float64], forgetting: float, data: st.DataObject
) -> None:
    stop = data.draw(st.integers(0, len(rows)))
    straight, first = RecursiveLeastSquares(N, forgetting), RecursiveLeastSquares(N, forgetting)
    for row in rows[:stop]:
        first.update(row[:N], row[N])
    resumed = RecursiveLeastSquares.resume(copy_of(first.memory))
    for row in rows[stop:]:
        resumed.update(row[:N], row[N])
    for row in rows:
        straight.update(row[:N], row[N])
    assert resumed.memory.to_bytes() == straight.memory.to_bytes()
