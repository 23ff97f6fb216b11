"""Chart of the parameters of the adaptive model against those of the reference: drift of the plant from its model.

With d the difference of the parameters and C its covariance when all is well,

    T2 = g^2 d' C^-1 d,      out: T2 > limit.

*g, the remaining share of the excitation.* The best parameters depend on the excitation if there is noise in the
regressors or curvature in the plant. Trained on steps and then left at rest, a model adapts to the noise
and moves by dozens of standard deviations without anything wrong. The scores phi e of least squares hardly move: with H
their derivative by the parameters they move by H d, and H is small where excitation is lost. Where H has fallen to g H
the test on the scores (Rao's instead of Wald's) gives g^2 T2. So T2 is multiplied by that, with g the harmonic mean of
the eigenvalues of the mean square of the inputs in memory, in units of the training's, at most 1. Past outputs in the
regressor do not count in g, for a changed plant changes them.

*Directions without excitation in the training*, such as the lags of a constant input, are not charted: about them the
reference knows nothing that could turn out to be wrong.

*The covariance.* A model y = phi' theta + e that is learned by least squares with the forgetting factor f obeys, with w
= 1 - f and an average over the rows in memory on both sides,

    mean(phi phi') (theta_k - theta) = z_k,       z_k = (1 - w) z_(k-1) + w phi_k e_k,

so its error is H^-1 z with H = E[phi phi'], and z is a moving average of the scores phi e. Where they are correlated
for less long than the memory lasts, z has the variance w / (2 - w) Omega, with Omega the sum of their covariances over
all lags, and the parameters

    w / (2 - w) V,      V = H^-1 Omega H^-1

(Ljung & Gunnarsson 1990, Adaptation and tracking in system identification - a survey, Automatica 26). The textbook's V,
s^2 H^-1, is that of residuals that are white and independent of the regressors. Those of a linear model of a plant that
is not linear are neither (White 1980, Econometrica 48; Newey & West 1987, Econometrica 55).

The reference is such a model stopped after N rows; its variance is larger by r = (1 + f^N) / (1 - f^N). So the
difference of the two has the covariance

    C = w / (2 - w) (1 + r) V.

Omega is learned by cosines, Omega = (c_1 c_1' + ... + c_K c_K') / K, with c_j the scores' coefficient of the j-th
cosine over the record and K = 0.4 rows^(2/3) (Lazarus, Lewis, Stock & Watson 2018, HAR inference: recommendations for
practice, J. Business & Economic Statistics 36). It errs as a covariance from K independent vectors does, so Hotelling's
F is its limit (Sun 2013, A heteroskedasticity and autocorrelation robust F test using an orthonormal series variance
estimator, Econometrics J. 16). Weights of Newey & West were no better (docs/charts.md).

*The limit.* If covariance and reference were known, the difference u of the parameters, made white, would be a MEWMA of
weight w with the rate of false alarms rate(h) = 1 / ARL at the limit h. The covariance comes from a training with nu
degrees of freedom. The statistic of a normal vector v is then |v|^2 / G with G independent of |v|, chi-square with nu -
p + 1 degrees of freedom over nu (that is Hotelling's F; Mardia, Kent & Bibby, Multivariate Analysis, 1979, section
3.5).

The reference has a constant error d, of r times the variance of u: the chart takes u - d, with 1 + r times the
variance. References differ; the rate of false alarms holds on average over the references. A rare alarm of an average
whose weight is small comes when u is carried out over the boundary of the region within the limit. As u falls back
towards 0 at the speed w u, in balance as many cross the boundary outwards for the first time as would drift inwards
there (the flux that gives Kramers' escape rate), and by Gauss's theorem that is, with all that is random in u, d and G
averaged over,

    w E[(|u|^2 - p) 1(out)].

Given v = (u - d) / sqrt(1 + r), the mean of |u|^2 - p is (|v|^2 - p) / (1 + r). So the average rate of false alarms at
the limit L of |v|^2 / G is that of the known chart, at the limits L G, over 1 + r:

    E_G[rate(L G)] / (1 + r).

With a reference so poor that the statistic is usually beyond the limit, there is one lasting false alarm.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from math import floor, inf, isfinite, log, sqrt

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.charts.base import LARGEST_VALUE, Chart, Judgement, vector
from reactorwatch.spc.charts.mewma import LARGEST_LIMIT, SMALLEST_WEIGHT_WITHOUT_SHIFT, mewma_run_length
from reactorwatch.spc.run_length import LONGEST_DESIGN, SHORTEST_DESIGN, check_range
from reactorwatch.stored_state import Memory

FIRST_HEIGHT = 0.5
"""Smallest limit: its rate of false alarms exceeds any that is asked for."""


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
    """Distance of the parameters from the reference's, scaled by the covariance of its chance part, see `learn`.

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
        made = np.array(root, dtype=np.float64, order="C")
        white = np.array([] if inputs is None else inputs, dtype=np.float64, order="C")
        white = white if white.size else white.reshape(0, len(names))
        self._use(ParameterMemory(tuple(names), made, limit, white, float(forgetting), np.eye(len(white))))

    def _use(self, memory: ParameterMemory) -> None:
        """See `Chart`."""
        self.memory, self.names = memory, memory.names
        self.limit = positive("limit", memory.limit)
        if not 0.0 < memory.forgetting < 1.0:
            raise InputError(f"forgetting must be in (0, 1), got {memory.forgetting}")
        for name, rows in (("root", memory.root), ("inputs", memory.inputs)):  # the kernel checks no bounds
            if rows.ndim != 2 or rows.shape[1] != len(memory.names) or not np.all(np.isfinite(rows)):
                columns = len(memory.names)
                raise InputError(
                    f"{name} must be rows of {columns} finite numbers, one a parameter, got {rows.tolist()}"
                )
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
        row = np.empty(0) if regressor is None else np.ascontiguousarray(regressor, dtype=np.float64)
        p, memory = len(self.names), self.memory
        statistic = np.nan
        if d.shape == (p,) and (regressor is None or row.shape == (p,)):
            statistic = _judge(d, row, memory.root, memory.inputs, memory.excitation, memory.forgetting)
        if statistic != statistic:
            vector(d, p)
            vector(row, p)
        return Judgement(statistic, float(len(memory.root)), 0.0, self.limit, statistic > self.limit)

    def contributions(self, difference: ArrayLike) -> Array:
        """Each parameter's part of T2, shape (p,): g^2 d_j (C^-1 d)_j, see `T2.contributions`."""
        d, root = vector(difference, len(self.names)), self.memory.root
        return np.asarray(self.excitation**2 * d * (root.T @ (root @ d)))

    def restart(self) -> None:
        """Forget the excitation; the models keep the parameters."""
        self.memory.excitation = np.eye(len(self.memory.inputs))


@jit
def _judge(difference: Array, row: Array, root: Array, inputs: Array, excitation: Array, forgetting: float) -> float:
    """T2, and the row taken into the excitation if there is one; NaN, and nothing changed, if a value is no number."""
    for value in difference:
        if not abs(value) < LARGEST_VALUE:
            return np.nan
    for value in row:
        if not abs(value) < LARGEST_VALUE:
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


def adaptive_weight(forgetting: float) -> float:
    """Weight of the newest row in an adaptive model with this forgetting factor."""
    return max(1.0 - forgetting, SMALLEST_WEIGHT_WITHOUT_SHIFT)


def learn(
    regressors: ArrayLike,
    residuals: ArrayLike,
    forgetting: float,
    reference_rows: int,
    arl0: float,
    names: Sequence[str],
    past_outputs: int,
) -> ParameterT2:
    """Design the chart of a model from a training record.

    Args:
        regressors: shape (rows, p), by time, in scaled units: outputs of the order of 1.
        residuals: residuals of any model with these regressors, in scaled units, shape (rows,); the part that the
            regressors still explain is removed.
        forgetting: forgetting factor f of the adaptive model, and of the reference in training, in [0.9, 0.9999].
        reference_rows: N, number of training rows of the reference.
        arl0: rows to a false alarm, averaged over the references of such trainings.
        names: names of the p parameters.
        past_outputs: number of leading regressors that are past outputs; the others are inputs and offset.

    Raises:
        InputError: an argument out of its range or of a wrong shape, a value that is not finite, or a training too
            short, without any excitation, or with all excitation of a parameter in a few rows.
    """
    phi, e = np.asarray(regressors, dtype=np.float64), np.asarray(residuals, dtype=np.float64)
    if phi.ndim != 2 or phi.shape[1] != len(names) or e.shape != phi.shape[:1]:
        raise InputError(
            f"regressors must have {len(names)} columns and as many rows as there are residuals, "
            f"got {phi.shape} and {e.shape}"
        )
    if not (np.all(np.isfinite(phi)) and np.all(np.isfinite(e))):
        raise InputError("regressors and residuals must be finite numbers; leave out the rows that are not")
    check_range("past_outputs", past_outputs, 0, len(names))
    check_range("reference_rows", reference_rows, 1, float("inf"))
    rows = len(phi)
    white = _whitening(phi)
    m, vectors = len(white), floor(0.4 * rows ** (2.0 / 3.0))
    if m == 0:
        raise InputError("regressors must vary or have an offset, all of them are 0")
    if vectors < 2 * m:  # fewer determine no covariance of m directions
        least = (2 * m / 0.4) ** 1.5
        raise InputError(f"training must have at least {least:.0f} rows for {m} parameters, got {rows}")
    # With fewer than 10 rows a direction in memory, H is not their average.
    check_range("forgetting", forgetting, max(0.9, 1.0 - 1.0 / (10 * m)), 1.0 - SMALLEST_WEIGHT_WITHOUT_SHIFT)
    weight = adaptive_weight(forgetting)

    z = phi @ white.T
    e = (e - z @ (z.T @ e) / rows) * sqrt(rows / (rows - m))
    # Without any noise rounding would count as drift.
    omega = _long_run_covariance(z * e[:, None], vectors) + 1e-9**2 * np.eye(m)
    memory = forgetting**reference_rows
    share = (1.0 + memory) / (1.0 - memory)
    # In coordinates that make the regressors white, V is Omega.
    values = np.linalg.eigvalsh(omega)
    if values[0] <= rows * np.finfo(np.float64).eps * values[-1]:
        raise InputError(
            "training must have moves of the inputs in more rows, parameters depend on a few rows of it only"
        )
    root = np.linalg.inv(np.linalg.cholesky(omega)) @ (z.T @ phi) / rows
    limit = parameter_limit(arl0, m, weight, vectors, share)
    inputs = np.zeros((0, len(names)))
    if past_outputs < len(names):
        of_inputs = _whitening(phi[:, past_outputs:])
        inputs = np.hstack([np.zeros((len(of_inputs), past_outputs)), of_inputs])
    return ParameterT2(names, root / sqrt(weight / (2.0 - weight) * (1.0 + share)), limit, inputs, forgetting)


def _whitening(rows: Array) -> Array:
    """Whitening matrix of rows, without removing a mean, shape (excited directions, columns)."""
    size = np.sqrt(np.mean(rows * rows, axis=0))
    unit = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
    scaled = rows * unit
    values, directions = np.linalg.eigh(scaled.T @ scaled / len(rows))
    kept = values > 1e-10 * max(values[-1], 1e-10)  # a smaller share of the largest is not excited
    return np.asarray((directions[:, kept] / np.sqrt(values[kept])).T * unit)


def _long_run_covariance(scores: Array, vectors: int) -> Array:
    """Sum of the scores' covariances over all lags, shape (m, m), from their slowest cosines."""
    rows = len(scores)
    phase = np.pi / rows * (np.arange(rows) + 0.5)
    coefficients = sqrt(2.0 / rows) * np.cos(np.outer(np.arange(1, vectors + 1), phase)) @ scores
    return np.asarray(coefficients.T @ coefficients / vectors)


def parameter_limit(arl0: float, dimension: int, weight: float, freedom: float, reference_share: float) -> float:
    """Limit of the statistic.

    Args:
        arl0: rows to a false alarm, averaged over the references.
        dimension: number of charted directions, p.
        weight: weight w of the newest row in the adaptive model.
        freedom: degrees of freedom nu of the learned covariance; at least p.
        reference_share: r, variance of the reference over that of the adaptive model.

    Raises:
        InputError: an argument out of its range, or a training so short that no limit gives that run length.
    """
    from scipy import optimize  # imported here, as it takes a tenth of a start

    check_range("arl0", arl0, SHORTEST_DESIGN * (1.0 + reference_share), LONGEST_DESIGN)
    rates = _rates(dimension, weight)
    half = 0.5 * (freedom - dimension + 1.0)
    # All but 1e-20 of the distribution of half of nu G; even steps of the log of it, so that small ones are there too.
    log_half = np.linspace(log(special.gammaincinv(half, 1e-20)), log(special.gammainccinv(half, 1e-20)), 2001)
    share = np.exp(half * (log_half - log(half)) - np.exp(log_half) + half)
    share /= share.sum()
    log_g = log_half - log(0.5 * freedom)

    def off(log_limit: float) -> float:
        return log(float(share @ np.exp(rates(log_limit + log_g)))) + log(arl0 / (1.0 + reference_share))

    largest = log(1e6)
    if off(largest) > 0.0:
        raise InputError(f"arl0 must be lower, or the training longer: it has {freedom:g} degrees of freedom")
    return float(np.exp(optimize.brentq(off, log(FIRST_HEIGHT), largest, xtol=1e-6)))


def prepare_limit(dimension: int, weight: float) -> Iterator[None]:
    """Compute what `parameter_limit` takes seconds for, up to half a second for each item of the iterator."""
    steps = 0
    for steps, _ in enumerate(_known_chart(dimension, weight), 1):  # noqa: B007 # their number counts
        yield
    if steps:  # else an argument is out of its range, which `parameter_limit` reports
        from scipy import interpolate, optimize  # noqa: F401 # the imports that `parameter_limit` needs

        yield
        _rates(dimension, weight)


@lru_cache(maxsize=16)
def _rates(dimension: int, weight: float) -> Callable[[Array], Array]:
    """Logarithm of a known chart's rate of false alarms by that of its limit; beyond the computed ones straight on."""
    from scipy import interpolate  # imported here, as it takes a tenth of a start

    known = list(_known_chart(dimension, weight))
    if not known:
        mewma_run_length(0.0, dimension, weight, FIRST_HEIGHT)  # raises: an argument is out of its range
    heights, rates = zip(*known, strict=True)
    first, last, inside = heights[0], heights[-1], interpolate.CubicSpline(heights, rates)
    slope = float(inside(last, 1))
    return lambda at: np.asarray(inside(np.clip(at, first, last)) + slope * np.maximum(at - last, 0.0))


def _known_chart(dimension: int, weight: float) -> Iterator[tuple[float, float]]:
    """Logarithms of a limit and the rate there, for growing limits up to the longest run length."""
    height = FIRST_HEIGHT
    while height < LARGEST_LIMIT and isfinite(rate := _log_rate(dimension, weight, height)):
        yield log(height), rate
        height *= 1.25


@lru_cache(maxsize=512)
def _log_rate(dimension: int, weight: float, height: float) -> float:
    """Logarithm of the rate of a known chart; -inf beyond the longest run length that can be computed."""
    try:
        return -log(mewma_run_length(0.0, dimension, weight, height))
    except InputError:
        return -inf
