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
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import LARGEST_VALUE, Array, Chart, ChartState, Judgement, positive, vector


class ParameterState(ChartState, frozen=True):
    """State of the chart: the arguments of `ParameterT2`, and its memory.

    Attributes:
        excitation: mean square of the inputs in memory in units of the training's, by rows.
    """

    names: list[str]
    root: list[list[float]]
    limit: float
    inputs: list[list[float]]
    forgetting: float
    excitation: list[list[float]]


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
    State = ParameterState

    def __init__(
        self,
        names: Sequence[str],
        root: ArrayLike,
        limit: float,
        inputs: ArrayLike | None = None,
        forgetting: float = 0.999,
    ) -> None:
        self.names = tuple(names)
        self.limit = positive("limit", limit)
        if not 0.0 < forgetting < 1.0:
            raise InputError(f"forgetting must be in (0, 1), got {forgetting}")
        self.forgetting = float(forgetting)
        self._root = _matrix("root", root, len(self.names))
        if not len(self._root):
            raise InputError("root must have a row for each direction that is charted, got none")
        self._inputs = _matrix("inputs", [] if inputs is None else inputs, len(self.names))
        self._excitation: Array = np.eye(len(self._inputs))

    @classmethod
    def from_state(cls, state: ParameterState) -> "ParameterT2":
        """Resume a chart, bit for bit, from its state.

        Raises:
            ValueError: the state is damaged.
        """
        chart = cls(state.names, state.root, state.limit, state.inputs, state.forgetting)
        excitation = np.array(state.excitation, dtype=np.float64).reshape(-1, len(chart._inputs) or 1)
        if excitation.shape[0] != len(chart._inputs) or not np.all(np.isfinite(excitation)):
            raise ValueError(f"excitation must be {len(chart._inputs)} rows of finite numbers, got {state.excitation}")
        chart._excitation = excitation
        return chart

    @property
    def state(self) -> ParameterState:
        """A copy of the full state."""
        return ParameterState(
            list(self.names),
            self._root.tolist(),
            self.limit,
            self._inputs.tolist(),
            self.forgetting,
            self._excitation.tolist(),
        )

    @property
    def excitation(self) -> float:
        """g, in [0, 1]."""
        return float(_share(self._excitation))

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
        p = len(self.names)
        statistic = np.nan
        if d.shape == (p,) and (regressor is None or row.shape == (p,)):
            statistic = _judge(d, row, self._root, self._inputs, self._excitation, self.forgetting)
        if statistic != statistic:
            vector(d, p)
            vector(row, p)
        return Judgement(statistic, float(len(self._root)), 0.0, self.limit, statistic > self.limit)

    def contributions(self, difference: ArrayLike) -> Array:
        """Each parameter's part of T2, shape (p,), in the order of `names`: g^2 d_j (C^-1 d)_j with C the covariance.

        Their sum is T2; one may be negative. See `T2.contributions`.
        """
        d = vector(difference, len(self.names))
        return np.asarray(self.excitation**2 * d * (self._root.T @ (self._root @ d)))

    def restart(self) -> None:
        """Forget the excitation; the models keep the parameters."""
        self._excitation = np.eye(len(self._inputs))


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
