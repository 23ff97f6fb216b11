"""Charts of many signals that are driven by few: T2 of what the signals have in common, SPE of the residual.

Jackson & Mudholkar (1979), Control procedures for residuals associated with principal component analysis,
Technometrics 21(3). Signals, each scaled by its mean and standard deviation in the training, are x. The eigenvectors of
their correlation matrix with the `a` largest eigenvalues l are the loadings P, and

    T2 = sum of t_i^2 / l_i with t = P' x,             unusually large, but related as always;
    SPE = |x - P t|^2,                                 related otherwise than before: a sensor, or a new cause.

Limits for a probability alpha of a false alarm per sample. T2, with n training rows (Jackson 1959; mean and
covariance are estimated, the sample is a new one):

    a (n^2 - 1) / (n (n - a)) F(a, n - a; 1 - alpha).

SPE, with th_i = sum of l_j^i over the components left out, h = 1 - 2 th_1 th_3 / (3 th_2^2) and c the normal quantile,
by the moments of a sum of chi-squares:

    th_1 (1 + c sqrt(2 th_2 h^2) / th_1 + th_2 h (h - 1) / th_1^2)^(1/h).
"""

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import Baseline, JointChart, Judgement, vector
from reactorwatch.spc.charts.t2 import T2
from reactorwatch.spc.false_alarm_budget import TrainingErrors
from reactorwatch.stored_state import Memory


class PcaModel(Memory):
    """PCA model of related signals: the full memory of the two charts.

    Attributes:
        mean: mean of each signal, length p.
        scale: standard deviation of each signal, length p.
        loadings: p rows of a numbers, orthonormal columns.
        variances: all p eigenvalues of the correlation matrix, falling.
        rows: number n of rows of the training.
        t2_limit: limit of T2.
        spe_limit: limit of SPE.
    """

    mean: list[float]
    scale: list[float]
    loadings: list[list[float]]
    variances: list[float]
    rows: int
    t2_limit: float
    spe_limit: float

    @classmethod
    def fit(cls, training: ArrayLike, components: int, false_alarm: float = 0.0027) -> Self:
        """The model of a training matrix.

        Args:
            training: shape (n, p), rows of a time when all was well.
            components: a, how many the signals have in common, in [1, p - 1].
            false_alarm: alpha, the probability of a false alarm per sample, of each of the two charts.

        Raises:
            InputError: an argument out of its range, or a signal that does not vary.
        """
        from scipy import stats

        matrix = np.asarray(training, dtype=np.float64)
        if matrix.ndim != 2 or not np.all(np.isfinite(matrix)):
            raise InputError(f"training must be a matrix of finite numbers, got shape {matrix.shape}")
        (n, p), a = matrix.shape, components
        if not 1 <= a <= p - 1:
            raise InputError(f"components must be in [1, {p - 1}] for {p} signals, got {a}")
        if n <= p:
            raise InputError(f"training must have more rows than its {p} signals, got {n}")
        mean, scale = matrix.mean(axis=0), matrix.std(axis=0, ddof=1)
        still = np.flatnonzero(scale <= 1e-12 * np.abs(mean))
        if still.size:
            raise InputError(f"training must vary in every signal, number {still[0]} does not; leave it out")
        _, singular, directions = np.linalg.svd((matrix - mean) / scale, full_matrices=False)
        variances = singular**2 / (n - 1)
        if variances[a] < 1e-12:
            raise InputError(f"components must leave some variance over, {a} of {p} signals leave none")
        t2 = a * (n * n - 1) / (n * (n - a)) * float(stats.f.isf(false_alarm, a, n - a))
        spe = _jackson_mudholkar_limit(variances[a:], false_alarm)
        return cls(mean.tolist(), scale.tolist(), directions[:a].T.tolist(), variances.tolist(), n, t2, spe)


class _PcaChart(JointChart):
    """Base class of the two charts: a model, and no memory."""

    memory_type = PcaModel
    has_memory = False

    def __init__(self, model: PcaModel) -> None:
        self._use(model)

    def _use(self, memory: PcaModel) -> None:
        """See `Chart`."""
        self.memory = self._model = model = memory
        self._mean, self._scale = np.array(model.mean), np.array(model.scale)
        self._loadings = np.array(model.loadings)
        p, a = len(model.mean), len(model.variances)
        if self._loadings.shape[:1] != (p,) or self._scale.shape != (p,) or a != p or not np.all(self._scale > 0):
            raise ValueError(f"the memory must hold loadings, scales and variances of its {p} signals")

    @classmethod
    def design(cls, baseline: Baseline) -> Self:
        """See `JointChart`; the signals have one component less in common than there are signals."""
        return cls(PcaModel.fit(baseline.e, len(baseline.learned) - 1, baseline.point_probability))

    @classmethod
    def obstacle(cls, e: Array, names: Sequence[str]) -> str:
        """See `JointChart`."""
        spans = np.ptp(e, axis=0) if len(e) else np.zeros(len(names))
        still = "" if np.all(spans > 0.0) else names[int(np.argmin(spans))]
        return super().obstacle(e, names) or (still and f"the residual of {still} does not vary in the training")

    @classmethod
    def relative_rates(cls, baseline: Baseline, errors: TrainingErrors) -> Array:
        """See `JointChart`; they count as those of T2."""
        return T2.relative_rates(baseline, errors)

    def restart(self) -> None:
        """Do nothing: there is no memory."""

    def _scale_values(self, x: ArrayLike) -> Array:
        return np.asarray((vector(x, self._mean.size) - self._mean) / self._scale)


class PcaT2(_PcaChart):
    """T2 of the components that the signals have in common.

    Args:
        model: from `PcaModel.fit`.

    Raises:
        ValueError: the model's parts don't fit together.
    """

    name = "pca_t2"

    def _use(self, memory: PcaModel) -> None:
        """See `Chart`."""
        super()._use(memory)
        a = self._loadings.shape[1]
        self._white: Array = self._loadings / np.sqrt(np.array(memory.variances[:a]))

    def update(self, x: ArrayLike) -> Judgement:
        """See `Chart`; x has shape (p,)."""
        scores = self._scale_values(x) @ self._white
        statistic = float(scores @ scores)
        return Judgement(statistic, float(scores.size), 0.0, self._model.t2_limit, statistic > self._model.t2_limit)

    def contributions(self, x: ArrayLike) -> Array:
        """Each signal's part of T2, shape (p,): x_j (P l^-1 P' x)_j. Their sum is T2; one may be negative."""
        scaled = self._scale_values(x)
        return np.asarray(scaled * (self._white @ (scaled @ self._white)))


class PcaSpe(_PcaChart):
    """The squared prediction error (also called Q): what the common components do not explain.

    Args:
        model: from `PcaModel.fit`.

    Raises:
        ValueError: the model's parts don't fit together.
    """

    name = "pca_spe"

    def update(self, x: ArrayLike) -> Judgement:
        """See `Chart`; x has shape (p,)."""
        statistic = float(self.contributions(x).sum())
        centre = sum(self._model.variances[self._loadings.shape[1] :])
        return Judgement(statistic, centre, 0.0, self._model.spe_limit, statistic > self._model.spe_limit)

    def contributions(self, x: ArrayLike) -> Array:
        """Each signal's part of SPE, shape (p,): its squared residual. Their sum is SPE."""
        scaled = self._scale_values(x)
        return np.asarray((scaled - self._loadings @ (scaled @ self._loadings)) ** 2)


def _jackson_mudholkar_limit(left_out: Array, alpha: float) -> float:
    from scipy import stats

    th1, th2, th3 = (float(np.sum(left_out**i)) for i in (1, 2, 3))
    h = 1.0 - 2.0 * th1 * th3 / (3.0 * th2 * th2)
    c = float(stats.norm.isf(alpha)) * (1.0 if h > 0.0 else -1.0)
    inner = c * np.sqrt(2.0 * th2 * h * h) / th1 + 1.0 + th2 * h * (h - 1.0) / th1**2
    return float(th1 * inner ** (1.0 / h))
