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

`Components` are also the model of the charts whose T2 and SPE are averaged: `pls`, `multiple_pca`, `multiway_pca`.
"""

from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import Baseline, JointChart, Judgement, vector
from reactorwatch.spc.charts.t2 import T2
from reactorwatch.spc.false_alarm_budget import TrainingErrors
from reactorwatch.stored_state import Memory

EXPLAINED = 0.9
"""Share of the variance that principal components have, and of the squared canonical correlations a state."""


class Components(NamedTuple):
    """Components of centred signals x: the scores t = R' x, and P t, what they explain of x.

    Attributes:
        rotations: R, shape (signals, components); equal to the loadings for principal components.
        loadings: P, same shape.
        variances: variance of each score, shape (components,); one without variance counts for nothing.
        rest: variance that they leave, of all signals together, shape (1,).
    """

    rotations: Array
    loadings: Array
    variances: Array
    rest: Array

    @classmethod
    def principal(cls, covariance: Array) -> Self:
        """The fewest principal components that explain `EXPLAINED` of the variance; at least one direction is left."""
        values, vectors = np.linalg.eigh(covariance)
        values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
        shares = np.cumsum(values) / values.sum()
        count = min(int(np.searchsorted(shares, EXPLAINED) + 1), len(values) - 1)
        rest = max(float(values[count:].sum()), 1e-12 * float(values.sum()))
        loadings = np.ascontiguousarray(vectors[:, :count])
        return cls(loadings, loadings, values[:count], np.array([rest]))

    @classmethod
    def of(cls, model: Mapping[str, Array]) -> Self:
        """Components among the arrays of a model, by name."""
        return cls(*(model[name] for name in cls._fields))

    def t2_parts(self, x: Array) -> Array:
        """Each signal's part of T2 of a row, both of shape (signals,): x_j (R l^-1 t)_j; one may be negative."""
        used = self.variances > 0.0
        weighted = np.where(used, x @ self.rotations / np.where(used, self.variances, 1.0), 0.0)
        return np.asarray(x * (self.rotations @ weighted))

    def spe_parts(self, x: Array) -> Array:
        """Each signal's part of SPE of a row, both of shape (signals,): its squared residual."""
        return np.asarray((x - self.loadings @ (x @ self.rotations)) ** 2)

    def relative_parts(self, x: Array) -> Array:
        """Each signal's part of T2 and of SPE, divided by their means, shape (2, signals)."""
        used = max(int(np.count_nonzero(self.variances > 0.0)), 1)
        return np.array([self.t2_parts(x) / used, self.spe_parts(x) / self.rest])


def standardise(values: Array) -> tuple[Array, Array, Array]:
    """Mean and standard deviation of each signal, 1 for a constant one, and the scaled deviations of the rows."""
    centre, scale = values.mean(axis=0), values.std(axis=0, ddof=1)
    scale = np.where(scale > 0.0, scale, 1.0)
    return centre, scale, (values - centre) / scale


class PcaModel(Memory):
    """PCA model of related signals: the full memory of the two charts.

    Attributes:
        mean: mean of each signal, shape (p,).
        scale: standard deviation of each signal, shape (p,).
        loadings: shape (p, a), orthonormal columns.
        variances: all p eigenvalues of the correlation matrix, falling.
        t2_limit: limit of T2.
        spe_limit: limit of SPE.
    """

    mean: Array
    scale: Array
    loadings: Array
    variances: Array
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
        mean, scale, scaled = standardise(matrix)
        still = np.flatnonzero(matrix.std(axis=0) <= 1e-12 * np.abs(mean))
        if still.size:
            raise InputError(f"training must vary in every signal, number {still[0]} does not; leave it out")
        _, singular, directions = np.linalg.svd(scaled, full_matrices=False)
        variances = singular**2 / (n - 1)
        if variances[a] < 1e-12:
            raise InputError(f"components must leave some variance over, {a} of {p} signals leave none")
        t2 = a * (n * n - 1) / (n * (n - a)) * float(stats.f.isf(false_alarm, a, n - a))
        loadings = np.ascontiguousarray(directions[:a].T)
        return cls(mean, scale, loadings, variances, t2, _jackson_mudholkar_limit(variances[a:], false_alarm))


class _PcaChart(JointChart):
    """Base class of the two charts: a model, and no memory.

    Args:
        model: from `PcaModel.fit`.

    Raises:
        ValueError: the model's parts don't fit together.
    """

    memory_type = PcaModel
    has_memory = False
    statistic: ClassVar[int]  # 0: T2, 1: SPE

    def __init__(self, model: PcaModel) -> None:
        self._use(model)

    def _use(self, memory: PcaModel) -> None:
        """See `Chart`."""
        loadings, variances, p = memory.loadings, memory.variances, memory.mean.size
        if loadings.shape[:1] != (p,) or memory.scale.shape != (p,) or variances.shape != (p,):
            raise ValueError(f"the memory must hold loadings, scales and variances of its {p} signals")
        if not np.all(memory.scale > 0):
            raise ValueError(f"scales must be positive, got {memory.scale.tolist()}")
        a = loadings.shape[1]
        self.memory = memory
        components = Components(loadings, loadings, variances[:a], np.array([variances[a:].sum()]))
        self._parts = (components.t2_parts, components.spe_parts)[self.statistic]
        self._centre = (float(a), float(variances[a:].sum()))[self.statistic]
        self._limit = (memory.t2_limit, memory.spe_limit)[self.statistic]

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

    def update(self, x: ArrayLike) -> Judgement:
        """See `Chart`; x has shape (p,)."""
        statistic = float(self.contributions(x).sum())
        return Judgement(statistic, self._centre, 0.0, self._limit, statistic > self._limit)

    def contributions(self, x: ArrayLike) -> Array:
        """See `JointChart`; their sum is the statistic."""
        memory = self.memory
        return self._parts((vector(x, memory.mean.size) - memory.mean) / memory.scale)

    def restart(self) -> None:
        """Do nothing: there is no memory."""


class PcaT2(_PcaChart):
    """T2 of the components that the signals have in common."""

    name = "pca_t2"
    statistic = 0


class PcaSpe(_PcaChart):
    """The squared prediction error (also called Q): what the common components do not explain."""

    name = "pca_spe"
    statistic = 1


def _jackson_mudholkar_limit(left_out: Array, alpha: float) -> float:
    from scipy import stats

    th1, th2, th3 = (float(np.sum(left_out**i)) for i in (1, 2, 3))
    h = 1.0 - 2.0 * th1 * th3 / (3.0 * th2 * th2)
    c = float(stats.norm.isf(alpha)) * (1.0 if h > 0.0 else -1.0)
    inner = c * np.sqrt(2.0 * th2 * h * h) / th1 + 1.0 + th2 * h * (h - 1.0) / th1**2
    return float(th1 * inner ** (1.0 / h))
