"""Chart of the parameters of the adaptive model against those of the reference: drift of the plant from its model.

With d the difference of the parameters and C its covariance when all is well,

    T2 = g^2 d' C^-1 d,      out: T2 > limit.

`reactorwatch.spc.parameter_drift` learns C from a training; the limit is that of a moving average, for the parameters
of a model that forgets are one.

*g, the remaining share of the excitation.* The best parameters depend on the excitation if there is noise in the
regressors or curvature in the plant. Trained on steps and then left at rest, a model adapts to the noise
and moves by dozens of standard deviations without anything wrong. The scores phi e of least squares hardly move: with H
their derivative by the parameters they move by H d, and H is small where excitation is lost. Where H has fallen to g H
the test on the scores (Rao's instead of Wald's) gives g^2 T2. So T2 is multiplied by that, with g the harmonic mean of
the eigenvalues of the mean square of the inputs in memory, in units of the training's, at most 1. Past outputs in the
regressor do not count in g, for a changed plant changes them.

*Directions without excitation in the training*, such as the lags of a constant input, are not charted: about them the
reference knows nothing that could turn out to be wrong.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.charts.base import LARGEST_VALUE, Array, Chart, Judgement, vector
from reactorwatch.stored_state import Memory


class ParameterMemory(Memory):
    """Memory of the chart: the arguments of `ParameterT2`, and the excitation.

    Attributes:
        excitation: mean square of the inputs in memory in units of the training's, shape (q, q).
    """

    names: tuple[str, ...]
    root: Array
    limit: float
    inputs: Array
    forgetting: float
    excitation: Array


class ParameterT2(Chart):
    """Distance of the parameters from the reference's, scaled by the covariance of its chance part.

    Usually `reactorwatch.spc.parameter_drift.learn` makes it.

    >>> chart = ParameterT2(["a1", "b1"], [[100.0, 0.0], [0.0, 20.0]], limit=16.0)
    >>> chart.update([0.01, 0.05]).out, chart.update([0.05, 0.05]).out
    (False, True)
    >>> dict(zip(chart.names, chart.contributions([0.05, 0.05]).tolist()))
    {'a1': 25.0, 'b1': 1.0}

    Args:
        names: names of the p parameters.
        root: shape (m, p) for m directions that are charted: root' root is the inverse of the difference's covariance.
        limit: limit of T2.
        inputs: shape (q, p): makes the inputs in a regressor, and the 1 of an offset, white as in the training; without
            it nothing is known of their excitation, and it is taken to be as in the training.
        forgetting: forgetting factor of the adaptive model.

    Raises:
        InputError: an argument out of its range, or of a shape that does not fit the names.
    """

    name = "parameters"
    memory_type = ParameterMemory

    def __init__(
        self,
        names: Sequence[str],
        root: ArrayLike,
        limit: float,
        inputs: ArrayLike | None = None,
        forgetting: float = 0.999,
    ) -> None:
        names, made = tuple(names), _matrix("root", root, len(names))
        white = _matrix("inputs", [] if inputs is None else inputs, len(names))
        self._use(ParameterMemory(names, made, limit, white, float(forgetting), np.eye(len(white))))

    def _use(self, memory: ParameterMemory) -> None:
        """See `Chart`."""
        self.memory, self.names = memory, memory.names
        self.limit = positive("limit", memory.limit)
        if not 0.0 < memory.forgetting < 1.0:
            raise InputError(f"forgetting must be in (0, 1), got {memory.forgetting}")
        if not len(memory.root):
            raise InputError("root must have a row for each direction that is charted, got none")
        q, excitation = len(memory.inputs), memory.excitation
        if excitation.shape != (q, q) or not np.all(np.isfinite(excitation)):
            raise ValueError(f"excitation must be {q} rows of finite numbers, got {excitation.tolist()}")

    @property
    def excitation(self) -> float:
        """g, in [0, 1]."""
        return float(_share(self.memory.excitation))

    def update(self, difference: ArrayLike, regressor: ArrayLike | None = None) -> Judgement:
        """Judge the parameters after a row; see `Chart`.

        Args:
            difference: adaptive parameters minus those of the reference, shape (p,), in the units of the training.
            regressor: regressor of the row, shape (p,), in the same units; without it the row is taken to excite as
                those in memory.

        Raises:
            ValueError: a wrong shape, or a value that is not finite; the chart's state is as before.
        """
        d = np.ascontiguousarray(difference, dtype=np.float64)
        row = _NO_ROW if regressor is None else np.ascontiguousarray(regressor, dtype=np.float64)
        p, memory = len(self.names), self.memory
        statistic = np.nan
        if d.shape == (p,) and (regressor is None or row.shape == (p,)):
            statistic = _judge(d, row, memory.root, memory.inputs, memory.excitation, memory.forgetting)
        if statistic != statistic:
            vector(d, p)
            vector(row, p)
        return Judgement(statistic, float(len(memory.root)), 0.0, self.limit, statistic > self.limit)

    def contributions(self, difference: ArrayLike) -> Array:
        """Each parameter's part of T2, shape (p,), in the order of `names`: g^2 d_j (C^-1 d)_j with C the covariance.

        Their sum is T2; one may be negative. See `T2.contributions`.
        """
        d, root = vector(difference, len(self.names)), self.memory.root
        return np.asarray(self.excitation**2 * d * (root.T @ (root @ d)))

    def restart(self) -> None:
        """Forget the excitation; the models keep the parameters."""
        self.memory.excitation = np.eye(len(self.memory.inputs))


def _matrix(name: str, values: ArrayLike, columns: int) -> Array:
    matrix = np.array(values, dtype=np.float64, order="C")
    if matrix.size == 0:
        matrix = matrix.reshape(0, columns)
    if matrix.ndim != 2 or matrix.shape[1] != columns or not np.all(np.isfinite(matrix)):
        raise InputError(f"{name} must be rows of {columns} finite numbers, one a parameter, got {matrix.tolist()}")
    return matrix


_NO_ROW: Array = np.zeros(0)


@jit
def _judge(difference: Array, row: Array, root: Array, inputs: Array, excitation: Array, forgetting: float) -> float:
    """T2, and the row taken into the excitation if there is one; NaN, and nothing changed, if a value is no number."""
    for j in range(difference.size):
        if not abs(difference[j]) < LARGEST_VALUE:
            return np.nan
    for j in range(row.size):
        if not abs(row[j]) < LARGEST_VALUE:
            return np.nan
    if row.size:
        white = np.empty(len(inputs))
        for i in range(len(inputs)):
            total = 0.0
            for j in range(row.size):
                total += inputs[i, j] * row[j]
            white[i] = total
        for i in range(len(inputs)):
            for j in range(len(inputs)):
                excitation[i, j] = forgetting * excitation[i, j] + (1.0 - forgetting) * white[i] * white[j]
    statistic = 0.0
    for i in range(len(root)):
        total = 0.0
        for j in range(difference.size):
            total += root[i, j] * difference[j]
        statistic += total * total
    share = _share(excitation)
    return share * share * statistic


@jit
def _share(excitation: Array) -> float:
    """The harmonic mean of a matrix's eigenvalues, at most 1; 0 if one is 0, and 1 for a matrix of no size.

    It is the size over the trace of the inverse, which is the sum of squares of the inverse of the Cholesky factor.
    """
    n = len(excitation)
    factor, inverse = np.zeros((n, n)), np.zeros((n, n))
    trace = 0.0
    for i in range(n):
        for j in range(i + 1):
            rest = excitation[i, j]
            for k in range(j):
                rest -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = rest / factor[j, j]
            elif rest > 1e-12:
                factor[i, i] = np.sqrt(rest)
            else:
                return 0.0
        for j in range(i + 1):
            entry = 1.0 if i == j else 0.0
            for k in range(j, i):
                entry -= factor[i, k] * inverse[k, j]
            inverse[i, j] = entry / factor[i, i]
            trace += inverse[i, j] * inverse[i, j]
    return min(1.0, n / trace) if n else 1.0
