"""The filter and smoother of a forcing, beside the joint normal distribution of everything written out in full."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.unknown_input.smoother import PathModel, normalize_columns, smooth

ROWS, N_X, N_Y = 7, 2, 2
VARIANCE = 0.7
R = np.array([0.3, 0.5])


class Written(NamedTuple):
    """A linear system and what is seen of it; and the mean and covariance of all states, in a row."""

    linear: PathModel
    kept: Array
    offset: Array
    seen: Array
    mean: Array
    covariance: Array
    of_states: Array


def written(again: int = 0) -> Written:
    """A random one; `again`: a row in which all begins anew."""
    random = np.random.default_rng(3)
    F, G = random.normal(size=(ROWS, N_X, N_X)) * 0.6, random.normal(size=(ROWS, N_X))
    H, D = random.normal(size=(ROWS, N_Y, N_X)), random.normal(size=(ROWS, N_Y))
    q = random.uniform(0.05, 0.2, (ROWS, N_X))
    start, spread = random.normal(size=(ROWS, N_X)), np.tile(np.array([[1.0, 0.3], [0.3, 0.6]]), (ROWS, 1, 1))
    kept = random.uniform(0.4, 0.95, ROWS)
    began = np.zeros(ROWS, dtype=np.bool_)
    began[[0, again]] = True
    used = np.repeat(~began[:, None], N_Y, axis=1)
    used[3, 1] = False
    offset, seen = random.normal(size=(ROWS, N_X, 1)), random.normal(size=(ROWS, N_Y, 1))
    n = N_X + 1
    mean, covariance = np.zeros(ROWS * n), np.zeros((ROWS * n, ROWS * n))
    of_states = np.zeros((ROWS * N_Y, ROWS * n))
    for k in range(ROWS):
        here, before = slice(k * n, (k + 1) * n), slice((k - 1) * n, k * n)
        of_states[k * N_Y : (k + 1) * N_Y, here] = np.column_stack([H[k], D[k]])
        if began[k]:
            mean[here] = [*start[k], 0.0]
            covariance[here, here] = np.block([[spread[k], np.zeros((N_X, 1))], [np.zeros((1, N_X)), VARIANCE]])
            continue
        A = np.block([[F[k], G[k][:, None]], [np.zeros((1, N_X)), kept[k]]])
        mean[here] = A @ mean[before] + [*offset[k, :, 0], 0.0]
        covariance[here] = A @ covariance[before]
        covariance[:, here] = covariance[here].T
        noise = np.diag([*q[k], VARIANCE * (1.0 - kept[k] ** 2)])
        covariance[here, here] = A @ covariance[before, before] @ A.T + noise
    linear = PathModel(F, G, H, D, q, used, began, start, spread)
    return Written(linear, kept, offset, seen, mean, covariance, of_states)


@pytest.mark.parametrize("again", [0, 4])
def test_the_likelihood_is_that_of_the_joint_distribution(again: int) -> None:
    all_of = written(again)
    w, logs = normalize_columns(all_of.linear, R, all_of.kept, VARIANCE, all_of.offset, all_of.seen)
    used = all_of.linear.used.ravel()
    C = all_of.of_states[used]
    told = multivariate_normal(C @ all_of.mean, C @ all_of.covariance @ C.T + np.diag(np.tile(R, ROWS)[used]))
    found = -0.5 * float(np.sum(w**2)) - logs - 0.5 * np.count_nonzero(used) * np.log(2.0 * np.pi)
    assert found == pytest.approx(float(told.logpdf(all_of.seen.ravel()[used])), rel=1e-10)


@pytest.mark.parametrize("again", [0, 4])
def test_the_smoothed_states_are_the_means_given_everything_that_is_seen(again: int) -> None:
    all_of = written(again)
    d, m = smooth(all_of.linear, R, all_of.kept, VARIANCE, all_of.offset[:, :, 0], all_of.seen[:, :, 0])
    used = all_of.linear.used.ravel()
    C = all_of.of_states[used]
    S = C @ all_of.covariance @ C.T + np.diag(np.tile(R, ROWS)[used])
    given = all_of.mean + all_of.covariance @ C.T @ np.linalg.solve(S, all_of.seen.ravel()[used] - C @ all_of.mean)
    np.testing.assert_allclose(np.column_stack([d, m]).ravel(), given, atol=1e-10)


def test_a_further_column_is_whitened_as_the_difference_that_it_makes() -> None:
    all_of = written()
    random = np.random.default_rng(4)
    more, shown = random.normal(size=(ROWS, N_X, 1)), random.normal(size=(ROWS, N_Y, 1))
    columns = normalize_columns(
        all_of.linear,
        R,
        all_of.kept,
        VARIANCE,
        np.concatenate([all_of.offset, more], axis=2),
        np.concatenate([all_of.seen, shown], axis=2),
    )[0]
    whole = normalize_columns(
        all_of.linear, R, all_of.kept, VARIANCE, all_of.offset + 2.0 * more, all_of.seen + 2.0 * shown
    )[0]
    np.testing.assert_allclose(columns[:, :, 0] + 2.0 * columns[:, :, 1], whole[:, :, 0], atol=1e-12)
