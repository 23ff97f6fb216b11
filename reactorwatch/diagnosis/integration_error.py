"""Does what is left look like the error of an integrator's steps, or of the times of the record?

A record that was itself computed, with a coarser integrator than ours, differs from our simulation by that
integrator's error: small, not white, and going with how sharply the plant turns. The error of one Euler step is, to its
leading order, h^2/2 d2x/dt2 (Hairer, Noersett & Wanner 1993, Solving Ordinary Differential Equations I, II.1); an input
that acts a little later or earlier than it is stamped makes one of the same shape. So the one-step residuals are set
beside it.
"""

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.innovations import FilterResult
from reactorwatch.process.model import ProcessModel

LEAST_CORRELATION = 0.15
"""Of the residuals with that error, in every output; by chance, in a thousand rows, it is some hundredths."""


def looks_like_integration(model: ProcessModel, run: Run, found: FilterResult) -> bool:
    """Whether the residuals of every output go with the error of a coarse step.

    Args:
        model: nominal; its first outputs' errors are those of its states as they show.
        run: the record.
        found: the run of the nominal model's filter.
    """
    error = _shown_error(model, run, found.x)
    for residual, shape in zip(found.residual[1:].T, error.T, strict=True):
        known = np.isfinite(residual) & np.isfinite(shape)
        if known.sum() < 100 or np.ptp(shape[known]) == 0.0:
            return False
        if abs(float(np.corrcoef(residual[known], shape[known])[0, 1])) < LEAST_CORRELATION:
            return False
    return True


def _shown_error(model: ProcessModel, run: Run, x: Array) -> Array:
    """How an Euler step from each row errs in the outputs, shape (rows - 1, n_y)."""
    state, u, p = model.arguments()
    t, h = ca.SX.sym("t"), ca.SX.sym("h")
    f = model.function()
    slope = f(state, u, p, t, t)[0]
    after = state + h * slope
    curved = after + 0.5 * h * (f(after, u, p, t, t)[0] - slope)
    error = f(curved, u, p, t, t)[1] - f(after, u, p, t, t)[1]
    function = CompiledFunction(ca.Function("error", [state, u, p, t, h], [error]), shared=[2])
    found = function.map(x[:-1], run.inputs[:-1], model.values(), run.time_min[:-1], np.diff(run.time_min))
    return found[0][:, :, 0]
