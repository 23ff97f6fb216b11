"""Instrumental variable estimate: parameters without a bias from measurement noise, in closed form.

Least squares on noisy lagged outputs is biased: the noise is in the regressors too. The instrumental variable method
replaces them, on one side of the equations, by a simulation of the last model, which is free of noise: Z'X p = Z'y
with Z the regressors of that run (Soderstrom and Stoica, System Identification, 1989, chapter 8; the iteration of
Young, Automatica 6 (1970) 271). Z = Q S, so Q'X p = Q'y is solved, whose condition is not squared.
"""

from dataclasses import replace

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.identification.batch import least_squares
from reactorwatch.identification.scaled_record import ScaledRecord
from reactorwatch.identification.simulation import simulate
from reactorwatch.identification.structure import Structure

_ITERATIONS = 5


def stable_arx(record: ScaledRecord) -> Array:
    """Parameters of the ARX model of a record of one output, its poles mirrored into the unit circle.

    Raises:
        InputError: too few rows, or rows that don't determine the parameters.
    """
    rows = record.rows()
    return stabilize(record.structure, least_squares(rows.regressors, rows.outputs).parameters)


def instrumental_variable(record: ScaledRecord) -> Array:
    """The instrumental variable estimate of a record of one output, shape (parameters,), its poles as of `stable_arx`.

    Raises:
        InputError: too few rows, or rows that don't determine the parameters.
    """
    structure, rows, theta = record.structure, record.rows(), stable_arx(record)
    for _ in range(_ITERATIONS):
        run = simulate(structure, theta, record.u, record.y, record.plan)
        # A simulation starts from measured rows.
        instruments = replace(record, y=np.where(np.isfinite(run), run, record.y)).rows()
        both = np.intersect1d(rows.position, instruments.position, assume_unique=True)
        x, y = (part[np.searchsorted(rows.position, both)] for part in (rows.regressors, rows.outputs[:, 0]))
        q, _ = np.linalg.qr(instruments.regressors[np.searchsorted(instruments.position, both)])
        equations = q.T @ x
        if np.linalg.cond(equations) > 1e12:
            break
        theta = stabilize(structure, np.asarray(np.linalg.solve(equations, q.T @ y)))
    return theta


def stabilize(structure: Structure, parameters: Array) -> Array:
    """Mirror poles on or outside the unit circle into it, with a small margin.

    Args:
        structure: structure of the model; one output.
        parameters: shape (parameters,).
    """
    lags = structure.output_lags
    inside = parameters.copy()
    inside[:lags] = mirror_poles(parameters[:lags])
    return inside


def mirror_poles(a: Array) -> Array:
    """Coefficients of y[k] = a1 y[k-1] + ... with the poles on or outside the unit circle mirrored into it.

    Args:
        a: shape (lags,).
    """
    poles = np.roots([1.0, *-a])
    outside = np.abs(poles) >= 1.0
    if not np.any(outside):
        return a
    poles[outside] = 0.98 / np.conj(poles[outside])
    return np.asarray(-np.real(np.poly(poles))[1:])
