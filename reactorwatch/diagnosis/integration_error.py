"""Detect residuals that resemble the error of an integrator's steps, or of the record's times.

A record that was computed with a coarser integrator differs from this simulation by that integrator's error: small, not
white, and correlated with the curvature of the trajectory. The error of one Euler step is, to leading order, h^2/2
d2x/dt2 (Hairer, Noersett & Wanner 1993, Solving Ordinary Differential Equations I, II.1); an input that acts a little
later or earlier than its time stamp causes an error of the same shape. So the one-step residuals are correlated with
it.
"""

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.batch import FilterResult
from reactorwatch.process.model import ProcessModel

LEAST_CORRELATION = 0.15
"""Minimum correlation in every output; by chance, in a thousand rows, it is some hundredths."""


def looks_like_integration(model: ProcessModel, run: Run, innovations: FilterResult) -> bool:
    """Return true if the residuals of every output are correlated with the error of a coarse step.

    Args:
        model: nominal model; its first outputs must be its states.
        run: the record.
        innovations: run of the nominal model's filter.
    """
    error = _shown_error(model, run, innovations.x)
    for residual, shape in zip(innovations.residual[1:].T, error.T, strict=True):
        finite = np.isfinite(residual) & np.isfinite(shape)
        if finite.sum() < 100 or np.ptp(shape[finite]) == 0.0:
            return False
        if abs(float(np.corrcoef(residual[finite], shape[finite])[0, 1])) < LEAST_CORRELATION:
            return False
    return True


def _shown_error(model: ProcessModel, run: Run, x: Array) -> Array:
    """Error of one Euler step from each row in the outputs, shape (rows - 1, n_y)."""
    state, u, p = model.arguments()
    t, h = ca.SX.sym("t"), ca.SX.sym("h")
    f = model.function()
    slope = f(state, u, p, t, t)[0]
    after = state + h * slope
    curved = after + 0.5 * h * (f(after, u, p, t, t)[0] - slope)
    error = f(curved, u, p, t, t)[1] - f(after, u, p, t, t)[1]
    function = CompiledFunction(ca.Function("error", [state, u, p, t, h], [error]), shared=[2])
    innovations = function.map(x[:-1], run.inputs[:-1], model.values(), run.time_min[:-1], np.diff(run.time_min))
    return innovations[0][:, :, 0]
