"""One hypothesis: effects with profiles in time, and their fit to a run.

The loss is the negative log likelihood of the innovations of the extended model's filter, with the loss function of
Huber (1964, Robust estimation of a location parameter, Annals of Mathematical Statistics 35): it is linear beyond
`HUBER` standard deviations. With process noise the filter follows the measurements, without any it is a simulation; so
a plant that starts on another branch, or is extinguished, does not mislead the fit. The loss is minimised by
damped Gauss-Newton steps (`descent`). Derivatives come from the filter's error equations (`signatures`).
Magnitudes of discontinuous effects, such as stiction, have no derivatives and are scanned (`scan`).

Prior probabilities of hypotheses, as costs in BIC (docs/decisions/0014-two-causes.md). Of n possible causes each is
there from the beginning with the probability 1/n, so that one is expected, and a cause that nothing in the catalogue
describes is as likely in each location as one of the catalogue. So two independent causes that are both there from the
beginning have 1/n of the prior odds of one, known or not: a cost of 2 log n. Causes that set in later are not charged
for it: one may follow from the other, and a time of its own is evidence of each.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import log

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.descent import CONVERGED, Equations, descend
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter, SharedPrefix, huber_clip, huber_weights
from reactorwatch.diagnosis.fitting.profiles import FittedProfile, Signal
from reactorwatch.diagnosis.fitting.signatures import inverse
from reactorwatch.diagnosis.parameter_priors import last_finite_row, offsets
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.batch import FilterResult, StepCost
from reactorwatch.kalman.error_dynamics import ErrorDynamics

WELL_CONVERGED = 0.005
"""Predicted gain in log likelihood below which a full fit ends."""

MOST_STEPS = 12
"""Maximum number of steps of a fit."""

MANY = 16
"""Number of parameters beyond which most of their derivatives are 0 in most rows, as those of a curve's knots are."""

_RUNAWAY = 1e100
"""Derivatives beyond this are useless: the filter has lost an unstable plant."""

_SHARE = 0.02
_WIDENINGS, _WIDER = 10, 2.0


@dataclass(frozen=True, eq=False)
class Fit:
    """A hypothesis at given parameters, with its innovations.

    Attributes:
        parameters: linear, then nonlinear parameters of each effect's profile.
        loss: negative log likelihood, up to a constant common to all hypotheses.
        w: normalised innovations, shape (rows, n_y); NaN where not measured.
        innovations: the filter run.
    """

    parameters: tuple[Array, ...]
    loss: float
    w: Array
    innovations: FilterResult


class Hypothesis:
    """Effects, each with a kind of profile.

    Args:
        filter: filter of the model with these effects.
        profiles: one profile for each effect.
    """

    def __init__(self, ekf: FaultFilter, profiles: Sequence[FittedProfile]) -> None:
        self.filter = ekf
        self.profiles = tuple(
            profile.with_constants(effect.constants) for profile, effect in zip(profiles, ekf.effects, strict=True)
        )

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(effect.name for effect in self.filter.effects)

    @property
    def n_parameters(self) -> int:
        """Number of fitted parameters, constants of the effects included."""
        return sum(profile.n_parameters for profile in self.profiles)

    @property
    def constant_indices(self) -> list[int]:
        """Indices of the effects' own constants among all parameters."""
        result, begin = list[int](), 0
        for profile in self.profiles:
            result += range(begin + profile.n_shape, begin + profile.n_parameters)
            begin += profile.n_parameters
        return result

    def evaluate(self, run: Run, parameters: Sequence[Array], like: Fit | None = None) -> Fit:
        """Clip the parameters to their bounds and run the filter.

        Args:
            run: the record.
            parameters: parameters of each effect.
            like: fit at other parameters and the present noise; rows before the first difference are copied from it.
        """
        return self.evaluate_all(run, [parameters], like)[0]

    def evaluate_all(self, run: Run, several: Sequence[Sequence[Array]], like: Fit | None = None) -> list[Fit]:
        """Evaluate several sets of parameters, which is faster than one by one."""
        possible = [self._clip(parameters) for parameters in several]
        signals = [self.signals_at(parameters) for parameters in possible]
        shared = None
        if like is not None:
            before = self.signals_at(self._complete(like.parameters))
            shared = [SharedPrefix(like.innovations, _count_equal_rows(item, before)) for item in signals]
        results = self.filter.evaluate_all(run, signals, shared)
        return [
            Fit(
                parameters, item.loss + 0.5 * float(np.sum(self._deviations(parameters) ** 2)), item.w, item.innovations
            )
            for parameters, item in zip(possible, results, strict=True)
        ]

    def evaluate_values(
        self, run: Run, fit: Fit, index: int, several: Sequence[Array], like: Fit | None = None
    ) -> Iterator[Fit]:
        """Evaluate other parameters of one effect, in batches; those of the others stay.

        Args:
            run: the record.
            fit: fit with the parameters of the other effects.
            index: index of the effect.
            several: sets of parameters of the effect.
            like: see `evaluate`.
        """
        sets = [[values if i == index else item for i, item in enumerate(fit.parameters)] for values in several]
        for begin in range(0, len(sets), LANES):
            yield from self.evaluate_all(run, sets[begin : begin + LANES], like)

    def _clip(self, parameters: Sequence[Array]) -> tuple[Array, ...]:
        return tuple(
            profile.clip(values, effect.lower, effect.upper)
            for profile, values, effect in zip(
                self.profiles, self._complete(parameters), self.filter.effects, strict=True
            )
        )

    def _complete(self, parameters: Sequence[Array]) -> list[Array]:
        return [profile.complete(values) for profile, values in zip(self.profiles, parameters, strict=True)]

    def fit(self, run: Run, start: Sequence[Array], steps: int = MOST_STEPS, like: Fit | None = None) -> Fit:
        """Fit the parameters by least squares; magnitudes of discontinuous effects stay.

        Args:
            run: the record.
            start: initial parameters of each effect.
            steps: maximum number of steps; fewer than `MOST_STEPS` are for a rough fit.
            like: see `evaluate`.
        """
        is_rough = steps < MOST_STEPS
        differences, last = self._difference_steps(), np.empty((0, 0))

        def equations(point: Fit) -> Equations | None:
            nonlocal differences, last
            if last.size and any(profile.nonlinear_parameters for profile in self.profiles):
                differences = self._widen(self._covariance(last), differences)
            with np.errstate(over="ignore", invalid="ignore"):
                last = g = self._jacobian(run, point, differences, rough=is_rough)
            if not np.any(g) or not np.max(np.abs(g)) < _RUNAWAY:
                return None
            w = np.nan_to_num(point.w[2:]).ravel()
            weights = huber_weights(w)
            weighted = g * np.sqrt(weights)[:, None]
            squares = signatures.gram_of_columns(weighted) if self.n_parameters > MANY else weighted.T @ weighted
            information, gradient = squares + self._prior_information(), g.T @ (weights * w)
            gradient[self.constant_indices] -= self._deviations(point.parameters) / self._constant_sds
            return information, gradient

        def move(point: Fit, step: Array) -> Fit:
            return self.evaluate(run, self._shift(point.parameters, step), like)

        enough = CONVERGED if is_rough else WELL_CONVERGED
        return descend(self.evaluate(run, start, like), equations, move, steps, enough)

    def covariance(self, run: Run, fit: Fit, first_difference: float = 0.0) -> Array:
        """Covariance of all parameters, shape (n_parameters, n_parameters).

        An onset matters only where something happens, so the derivative by it depends on the difference step. The step
        is about one standard deviation, and at least `first_difference`.
        """
        dynamics = self.error_dynamics(run, fit) if self.filter.delay_index is None else None
        differences = [np.maximum(item, first_difference) for item in self._difference_steps()]
        for _ in range(_WIDENINGS):
            result = self._covariance(self._jacobian(run, fit, differences, dynamics))
            before, differences = differences, self._widen(result, differences)
            if all(np.array_equal(*pair) for pair in zip(before, differences, strict=True)):
                break
        return result

    def offsets(self, fit: Fit) -> dict[str, float]:
        """Estimated offsets of the uncertain parameters of the plant, by name."""
        return offsets(self.filter.model, fit.innovations.x[last_finite_row(fit.innovations)])

    def offset_sds(self, run: Run, fit: Fit) -> dict[str, float]:
        """Standard deviations of the offsets, marginal over the hypothesis's parameters."""
        row = last_finite_row(fit.innovations)
        variances = np.diag(fit.innovations.P[row]).copy()
        if self.n_parameters == 0:
            return offsets(self.filter.model, np.sqrt(variances))
        covariance = self.covariance(run, fit)
        changes = np.maximum(np.sqrt(np.maximum(np.diag(covariance), 0.0)), 1e-300)
        moved = [self.signals_at(self._shift(fit.parameters, change)) for change in np.diag(changes)]
        there = np.array([item.innovations.x[row] for item in self.filter.evaluate_all(run, moved)])
        by = np.nan_to_num((there - fit.innovations.x[row]) / changes[:, None])
        return offsets(self.filter.model, np.sqrt(variances + np.einsum("ni,nm,mi->i", by, covariance, by)))

    def _covariance(self, g: Array) -> Array:
        """Covariance of the parameters from their Jacobian."""
        self.filter.spend(StepCost.COVARIANCE)
        known = self._prior_information()
        if np.max(np.abs(g), initial=0.0) < _RUNAWAY:  # else the rows tell nothing
            known = known + g.T @ g
        return inverse(known)

    def _prior_information(self) -> Array:
        """Prior information: the width of each parameter's range; of a constant, the standard deviation of its prior.

        Some records carry no information about an onset.
        """
        widths = np.concatenate([self._ranges(index) for index in range(len(self.profiles))])
        return np.diag(widths**-2.0)

    @property
    def _constant_sds(self) -> Array:
        return np.array([item.sd for profile in self.profiles for item in profile.constants])

    def _deviations(self, parameters: Sequence[Array]) -> Array:
        """Deviations of the effects' own constants from the means of their priors, in standard deviations."""
        pairs = zip(self.profiles, parameters, strict=True)
        return np.array(
            [
                (value - item.value) / item.sd
                for profile, values in pairs
                for item, value in zip(profile.constants, values[profile.n_shape :].tolist(), strict=True)
            ]
        )

    def constants_evidence(self, run: Run, fit: Fit) -> float:
        """Cost in BIC of the effects' own constants: twice the logarithm of the prior's volume over the posterior's.

        It is the Occam factor of Laplace's approximation (Kass & Raftery 1995, J. American Statistical Association 90),
        0 for constants on which the record has no information.
        """
        indices = self.constant_indices
        if not indices:
            return 0.0
        posterior = self._covariance(self._jacobian(run, fit, self._difference_steps()))[np.ix_(indices, indices)]
        scaled = posterior / np.outer(self._constant_sds, self._constant_sds)
        return max(-float(np.linalg.slogdet(scaled)[1]), 0.0)

    def _ranges(self, index: int) -> Array:
        """Widths of the ranges of an effect's parameters."""
        effect, profile = self.filter.effects[index], self.profiles[index]
        of_numbers = [number.upper - number.lower for number in profile.nonlinear_parameters]
        constants = [item.sd for item in profile.constants]
        return np.array([effect.upper - effect.lower] * profile.n_linear + of_numbers + constants)

    def _jacobian(
        self,
        run: Run,
        fit: Fit,
        differences: Sequence[Array],
        dynamics: ErrorDynamics | None = None,
        rough: bool = False,
    ) -> Array:
        """Derivatives of the innovations' reduction, shape (values from the third row on, n_parameters).

        With a delayed output the error equations are only approximate for the other effects. They do not contain the
        rows in which a timing shift grows, and these rows alone determine its onset.
        """
        late = self.filter.delay_index
        if dynamics is None and (late is None or (rough and len(self.profiles) > 1)):
            dynamics = self.error_dynamics(run, fit)
        columns = []
        for index, (profile, values, moved) in enumerate(zip(self.profiles, fit.parameters, differences, strict=True)):
            if index == late or dynamics is None:
                columns.append(self._finite_differences(run, fit, index, moved))
                continue
            apart = bool(profile.nonlinear_parameters) and self.filter.shifts_time(index)
            shape = values[profile.n_linear :]
            near = profile.basis_signals(shape) if apart else profile.derivatives(values, moved)
            interval_mean, sample_value = near.interval_mean, near.sample_value
            g = signatures.forward_signatures(dynamics, self.input_index(index), interval_mean[1:-1], sample_value[2:])
            columns.append(g.reshape(-1, interval_mean.shape[1]))
            if apart:
                columns.append(self._finite_differences(run, fit, index, moved, profile.n_linear))
                continue
            first, ones = self.filter.constant_index(index), np.ones((run.time_min.size - 2, 1))
            for number in range(len(profile.constants)):
                g = signatures.forward_signatures(dynamics, first + number, ones, ones)
                columns.append(g.reshape(-1, 1))
        return np.concatenate(columns, axis=1)

    def _finite_differences(self, run: Run, fit: Fit, index: int, moved: Array, first: int = 0) -> Array:
        """Derivatives by one effect's parameters, from the parameter `first` on, by finite differences.

        A nonlinear parameter's column with less information than its prior is rounding error, and is set to 0.
        """
        profile, signals = self.profiles[index], []
        size = _SHARE * self.filter.effects[index].typical
        steps = [*(size,) * profile.n_linear, *moved.tolist()]
        for number in range(first, profile.n_parameters):
            parameters = [item.copy() for item in fit.parameters]
            parameters[index][number] += steps[number]
            signals.append(self.signals_at(parameters))
        unchanged = self.signals(fit)
        shared = [SharedPrefix(fit.innovations, _count_equal_rows(item, unchanged)) for item in signals]
        before, results = huber_clip(fit.w[2:]), self.filter.evaluate_all(run, signals, shared)
        moves = zip(steps[first:], results, strict=True)
        result = np.stack([(before - huber_clip(item.w[2:])).ravel() / step for step, item in moves], axis=1)
        informative = np.sum(result**2, axis=0) >= self._ranges(index)[first:] ** -2.0
        informative[: profile.n_linear - first] = True
        return np.asarray(result * informative)

    def signatures(self, run: Run, fit: Fit, index: int, profile: FittedProfile) -> Array:
        """Derivatives of the innovations' reduction by the linear parameters of another profile.

        Args:
            run: the record.
            fit: fit at which the filter is linearised.
            index: index of the effect; it must not delay an output.
            profile: profile without nonlinear parameters.

        Returns:
            Shape (values from the third row on, n_linear).
        """
        interval_mean, sample_value = profile.basis_signals(np.empty(0))[:2]
        g = signatures.forward_signatures(
            self.error_dynamics(run, fit), self.input_index(index), interval_mean[1:-1], sample_value[2:]
        )
        return g.reshape(-1, profile.n_linear)

    def input_index(self, index: int) -> int:
        """Index of an effect among the error equations' inputs, which do not include a measurement delay."""
        late = self.filter.delay_index
        return index - (late is not None and late < index)

    def unexplained_sum(self, run: Run, fit: Fit) -> float:
        """Sum of squares of the innovations that no change of the parameters removes, linearised."""
        g, w = self._jacobian(run, fit, self._difference_steps()), np.nan_to_num(fit.w[2:]).ravel()
        gradient = g.T @ w
        return max(float(w @ w - gradient @ self._covariance(g) @ gradient), 0.0)

    def innovations_without(self, run: Run, fit: Fit, index: int) -> Array:
        """Normalised innovations of a filter without the deviation at this index, shape (rows, n_y)."""
        signals = self.signals(fit)
        signals[index] = Signal(np.zeros(run.time_min.size), np.zeros(run.time_min.size))
        return self.filter.evaluate(run, signals).w

    def _difference_steps(self) -> list[Array]:
        return [profile.difference_steps for profile in self.profiles]

    def _widen(self, covariance: Array, differences: Sequence[Array]) -> list[Array]:
        """Widen the difference steps towards the standard deviations, each by a factor of `_WIDER` at most."""
        sds, result, begin = np.sqrt(np.maximum(np.diag(covariance), 0.0)), [], 0
        for profile, before in zip(self.profiles, differences, strict=True):
            values = sds[begin + profile.n_linear : begin + profile.n_parameters]
            result.append(np.maximum(before, np.minimum(values, _WIDER * before)))
            begin += profile.n_parameters
        return result

    def error_dynamics(self, run: Run, fit: Fit) -> ErrorDynamics:
        """Error equations of the filter about a fit."""
        return self.filter.error_dynamics(run, self.signals(fit), fit.innovations)

    def signals(self, fit: Fit) -> list[Signal]:
        """Deviations of the effects at a fit."""
        return self.signals_at(fit.parameters)

    def signals_at(self, parameters: Sequence[Array]) -> list[Signal]:
        """Deviations of the effects at given parameters."""
        return [profile.signal(values) for profile, values in zip(self.profiles, parameters, strict=True)]

    def _shift(self, parameters: Sequence[Array], change: Array) -> list[Array]:
        moved, begin = [], 0
        for values in parameters:
            moved.append(values + change[begin : begin + values.size])
            begin += values.size
        return moved


def _count_equal_rows(one: Sequence[Signal], other: Sequence[Signal]) -> int:
    """Number of rows before the first in which a deviation differs."""
    rows = len(one[0].sample_value)
    differs = np.zeros(rows, dtype=np.bool_)
    for mine, theirs in zip(one, other, strict=True):
        if mine.constants != theirs.constants:
            return 0
        differs |= (mine.interval_mean != theirs.interval_mean) | (mine.sample_value != theirs.sample_value)
    return int(np.argmax(differs)) if differs.any() else rows


SOURCE_COST = 6.0
"""Cost in BIC of an unmodelled source, odds of twenty to one: a cause with a name has to be worse by more, before it
counts as unknown."""

FROM_BEGINNING = frozenset(("constant", "sine", "free"))
"""Profiles without an onset."""


def prior_cost(hypothesis: Hypothesis, n_causes: int) -> float:
    """Minus twice the logarithm of the prior odds of a hypothesis against a single named cause, of so many possible."""
    effects, profiles = hypothesis.filter.effects, hypothesis.profiles
    result = SOURCE_COST * sum(effect.is_source for effect in effects)
    if len(effects) > 1 and all(profile.name in FROM_BEGINNING for profile in profiles):
        result += 2.0 * log(n_causes)
    return result
