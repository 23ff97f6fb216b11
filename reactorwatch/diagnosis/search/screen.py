"""Screen of causes and profiles: all of them at once, linearised about a filter run.

If a hypothesis has been fitted, its filter run is used, and its own signature is added to the innovations: so
alternatives have to explain the same data instead of it. About a good fit the linearisation holds, and little process
noise hides what separates the alternatives. About the nominal model that noise has absorbed the deviation, and only
causes that stand out are found.

Effects with internal states, such as a lag, have no infinitesimal deviation; see `dynamic_and_pair_screens`.

Effects with other values of their own constants, so that a screen sees what those values do. A screen is linear about
the nominal constants, and a side reaction with twice the heat does something else. So an effect is also screened at the
start values of its constants, and a candidate takes them along.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from math import inf, log
from typing import TypeVar

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.augmented_model import augment_model
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter, error_dynamics_between, huber_clip
from reactorwatch.diagnosis.fitting.hypothesis import Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import (
    Constant,
    Decay,
    FittedProfile,
    PiecewiseLinear,
    Ramp,
    Signal,
    Sine,
    Step,
)
from reactorwatch.diagnosis.fitting.signatures import solve_bounded
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.error_dynamics import ErrorDynamics, ErrorLinearization
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel
from reactorwatch.progress import report_stage


class ConstantVariant(Effect):
    """An effect with fixed values of its own constants.

    Args:
        effect: the effect.
        values: values of its constants.

    Attributes:
        effect: the effect as given.
        values: the values as given.
    """

    def __init__(self, effect: Effect, values: Sequence[float]) -> None:
        self.effect, self.values = effect, tuple(values)
        facts = {"name": f"{effect.name}@{','.join(f'{value:g}' for value in values)}"}
        facts |= {name: getattr(effect, name) for name in ("label", "location", "unit", "lower", "upper", "typical")}
        for name, value in facts.items():
            setattr(self, name, value)

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        prefix, extended = self.effect.prefix(model), self.effect.apply(model, size)
        names = [f"{prefix}.{item.name}" for item in self.effect.constants]
        for name, value in zip(names, self.values, strict=True):
            extended = extended.substitute(extended.parameter(name).symbol, ca.SX(value))
        return replace(extended, parameters=tuple(item for item in extended.parameters if item.name not in names))


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def variants_of(effects: tuple[Effect, ...]) -> tuple[ConstantVariant, ...]:
    """Variants of effects, at every combination of the start values of their constants; made once."""
    return tuple(
        ConstantVariant(effect, values)
        for effect in effects
        if effect.constants
        for values in product(*(item.start_values for item in effect.constants))
    )


KNOTS = 12
DECAYS = (0.02, 0.1, 0.4)
"""Time constants of the decays that are screened, in spans of the record."""

SHORTEST_PERIOD_ROWS = 12
KNOWN_PERIODS = 10
"""Periods for which the norm of a sine's signature is computed; it is interpolated between them."""

_WELL_INSIDE = 0.6

EDGE_ROWS = 5
"""Rows at both ends of the record without candidates of an onset."""

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class Part:
    """A cause with a profile, as part of an explanation.

    Attributes:
        effect: the cause.
        profile: profile of its deviation.
        parameters: parameters of the profile.
    """

    effect: Effect
    profile: FittedProfile
    parameters: Array

    @property
    def label(self) -> tuple[str, str]:
        """Names of cause and profile."""
        return self.effect.name, self.profile.name


@dataclass(frozen=True, eq=False)
class Candidate(Part):
    """A cause with a profile and initial parameters that may explain the innovations.

    Attributes:
        gain: twice the log likelihood ratio that the linear model predicts.
    """

    gain: float

    def score(self, values: int) -> float:
        """Predicted gain in BIC."""
        return self.gain - self.profile.n_parameters * log(values)


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def _static_effects(model: ProcessModel, effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """Effects that add no state to a model."""
    return tuple(effect for effect in effects if effect.extend(model).state_names == model.state_names)


class Screen:
    """Screens a run for single causes.

    Args:
        model: process model of the plant.
        effects: the catalogue.
        run: the record.

    Attributes:
        model: process model of the plant.
        effects: the catalogue.
        static_effects: effects without internal states.
        dynamic_effects: effects with internal states.
    """

    def __init__(self, model: ProcessModel, effects: Sequence[Effect], run: Run) -> None:
        self.model, self._run, self.effects = model, run, tuple(effects)
        self._errors: dict[FaultFilter, ErrorLinearization] = {}
        self.static_effects = _static_effects(model, self.effects)
        self.dynamic_effects = tuple(effect for effect in effects if effect not in self.static_effects)
        self._columns = (*self.static_effects, *variants_of(self.static_effects))
        self._beta = np.diff(run.time_min[1:])
        t = run.time_min
        self._constant, self._step, self._ramp, self._decay = Constant(t), Step(t), Ramp(t), Decay(t)
        self._sine, self._free = Sine(t), PiecewiseLinear(t, KNOTS)

    def candidates(
        self, hypothesis: Hypothesis, fit: Fit, replaced: Sequence[int] = (), of: Sequence[Effect] | None = None
    ) -> list[Candidate]:
        """Best candidate of each cause and profile, the most promising first.

        Args:
            hypothesis: hypothesis about whose run everything is linearised.
            fit: fit of the hypothesis.
            replaced: indices of its effects to find alternatives for; the others stay.
            of: causes to screen among `static_effects`, at all start values of their constants; None: all.
        """
        of = self.static_effects if of is None else of
        report_stage(f"screening causes ({len(of)})")
        variants = (item for item in self._columns if isinstance(item, ConstantVariant) and item.effect in of)
        effects = (*of, *variants)
        with np.errstate(over="ignore", invalid="ignore"):  # the filter may have lost an unstable plant
            dynamics = self.dynamics_of_all(hypothesis, fit, replaced, effects)
            if not all_finite(dynamics):
                return []
            result = self._onset_candidates(dynamics, effects) + self.sine_candidates(dynamics, effects)
            result += self._profile_candidates(dynamics, effects, self._free, np.empty(0))
            for index in replaced:
                profile, parameters = hypothesis.profiles[index], fit.parameters[index]
                if profile.name != self._free.name:
                    shape = parameters[profile.n_linear : profile.n_shape]
                    result += self._profile_candidates(dynamics, effects, profile.with_constants(()), shape)
        result = [item for item in result if np.isfinite(item.gain) and np.all(np.isfinite(item.parameters))]
        result = [_with_constants(item) for item in result] + self._free_constants(dynamics, effects, result)
        return sorted(result, key=lambda item: -item.score(self._run.values))

    def _free_constants(
        self, dynamics: ErrorDynamics, effects: Sequence[Effect], candidates: Sequence[Candidate]
    ) -> list[Candidate]:
        """Constant deviation of each effect that has constants, with what they can gain between their start values.

        To first order a signature at constants between the start values is a sum of those at the start values.
        """
        w, result = dynamics.w.ravel(), []
        bases = dict.fromkeys(item.effect for item in effects if isinstance(item, ConstantVariant))
        constant = signatures.constant_signatures(dynamics, len(effects)) if bases else np.empty((w.size, 0))
        for base in bases:
            own = [index for index, item in enumerate(effects) if _base(item) is base]
            g = np.ascontiguousarray(constant[:, own])
            of_base = [item for item in candidates if _base(item.effect) is base and item.profile is self._constant]
            if of_base and np.all(np.isfinite(g)):
                by = np.linalg.lstsq(g, w, rcond=1e-9)[0]
                best = _with_constants(max(of_base, key=lambda item: item.gain))
                result.append(replace(best, gain=max(float(by @ (2.0 * g.T @ w - g.T @ (g @ by))), best.gain)))
        return result

    def dynamics_of_all(
        self, hypothesis: Hypothesis, fit: Fit, replaced: Sequence[int], of: Sequence[Effect] | None = None
    ) -> ErrorDynamics:
        """Error equations for all static effects, with the innovations that alternatives have to explain.

        Args:
            hypothesis: see `candidates`.
            fit: see `candidates`.
            replaced: see `candidates`.
            of: see `candidates`.
        """
        w = huber_clip(fit.w[2:])
        for index in replaced:
            w = w + self._signature_of(hypothesis, fit, index)
        effects = self.static_effects if of is None else of
        dynamics = self._dynamics(hypothesis.filter, hypothesis.signals(fit), fit, effects)
        return replace(dynamics, w=w)

    def _signature_of(self, hypothesis: Hypothesis, fit: Fit, index: int) -> Array:
        """Signature of a fitted deviation, shape (rows, n_y)."""
        ekf = hypothesis.filter
        if index == ekf.delay_index or ekf.effects[index].is_discontinuous or ekf.shifts_time(index):
            return huber_clip(hypothesis.innovations_without(self._run, fit, index)[2:]) - huber_clip(fit.w[2:])
        dynamics = hypothesis.error_dynamics(self._run, fit)
        interval_mean, sample_value = hypothesis.signals(fit)[index][:2]
        return signatures.forward_signatures(
            dynamics, hypothesis.input_index(index), interval_mean[1:-1, None], sample_value[2:, None]
        )[:, :, 0]

    def _dynamics(
        self, ekf: FaultFilter, signals: Sequence[Signal], fit: Fit, effects: Sequence[Effect]
    ) -> ErrorDynamics:
        """Error equations for some effects about a filter run."""
        if ekf.is_plain and all(effect in self.static_effects for effect in ekf.effects):
            errors, inputs = self._full_equations(ekf, signals)
        else:
            errors, inputs = self._equations_beside(ekf), ekf.inputs(self._run, signals)
        errors = errors.with_noise(ekf.noise_levels)
        errors.changes = ekf.noise.parameter_changes
        dynamics = error_dynamics_between(errors, self._run, inputs, fit.innovations, ekf.used_values(self._run))
        columns = [self._columns.index(effect) for effect in effects]
        return replace(dynamics, G=dynamics.G[:, :, columns], D=dynamics.D[:, :, columns])

    def _full_equations(self, ekf: FaultFilter, signals: Sequence[Signal]) -> tuple[ErrorLinearization, Array]:
        """Error equations of a model with all static effects, and its inputs.

        It is compiled once for all hypotheses.
        """
        of_all = augment_model(self.model, self._columns)
        nothing = np.zeros(self._run.time_min.size)
        by_effect = dict(zip(ekf.effects, signals, strict=True))
        sizes = [by_effect.get(effect, Signal(nothing, nothing)) for effect in self._columns]
        return of_all.errors, of_all.inputs(self._run.time_min, self._run.certain_inputs, sizes)

    def _equations_beside(self, ekf: FaultFilter) -> ErrorLinearization:
        """Error equations of a filter's model with all static effects added."""
        if ekf not in self._errors:
            extended = ekf.model
            interval_inputs, sample_inputs = [], []
            for effect in self._columns:
                own = ekf.size_symbols(effect)
                if own is None:
                    extended = effect.extend(extended)
                    own = (extended.parameters[-1].symbol,) * 2
                interval_inputs.append(own[0])
                sample_inputs.append(own[1])
            self._errors[ekf] = ErrorLinearization(extended, ekf.noise_levels, interval_inputs, sample_inputs)
        return self._errors[ekf]

    def _onset_candidates(self, dynamics: ErrorDynamics, effects: Sequence[Effect]) -> list[Candidate]:
        """Constants, steps, ramps and decays."""
        times, candidates = self._run.time_min[1:-1], []
        constants = self._run.span_min * np.array(DECAYS)
        sums_a, sums_b = signatures.onset_scan(dynamics, *self._onset_laws(constants))
        left_of_span = (self._step.end_min - times)[:, None]  # converts the slope of a ramp to its final size
        sums_a[1], sums_b[1] = sums_a[1] / left_of_span, sums_b[1] / left_of_span**2
        kinds: list[tuple[FittedProfile, int, tuple[float, ...]]]
        kinds = [(self._step, EDGE_ROWS, ()), (self._ramp, EDGE_ROWS, ())]
        kinds += [(self._decay, 0, (constant,)) for constant in constants.tolist()]
        for cause, effect in enumerate(effects):
            size, gain = _best(sums_a[0, :, cause], sums_b[0, :, cause], effect)
            candidates.append(Candidate(effect, self._constant, size[:1], float(gain[0])))
            for (profile, first, shape), a, b in zip(kinds, sums_a, sums_b, strict=True):
                size, gain = _best(a[:, cause], b[:, cause], effect)
                index = first + int(np.argmax(gain[first:-EDGE_ROWS]))
                parameters = profile.clip(np.array([size[index], times[index], *shape]), -np.inf, np.inf)
                candidates.append(Candidate(effect, profile, parameters, float(gain[index])))
        return candidates

    def _onset_laws(self, constants: Array) -> tuple[Array, Array, Array]:
        """Arguments of `signatures.onset_scan` for a ramp and for decays."""
        step = self._beta
        remaining = np.exp(-step / constants[:, None])
        beta = np.vstack([step, 1.0 - remaining])
        mean = np.vstack([0.5 * step, 1.0 - (1.0 - remaining) * constants[:, None] / step])
        return beta, np.vstack([np.ones_like(step), remaining]), mean

    def sine_candidates(self, dynamics: ErrorDynamics, effects: Sequence[Effect]) -> list[Candidate]:
        """Best sine of each cause."""
        interval_mean, sample_value = signatures.adjoint(dynamics)
        rows = round(self._run.span_min / self._run.period_min) + 1
        index = np.round((self._run.time_min[1:] - self._sine.start_min) / self._run.period_min).astype(int)
        count = 2 * rows
        frequency = np.fft.rfftfreq(count, self._run.period_min)
        inner = (frequency > 0.75 / self._run.span_min) & (
            frequency < 1.0 / (SHORTEST_PERIOD_ROWS * self._run.period_min)
        )
        angle = 2.0 * np.pi * frequency[inner]
        candidates = []
        periods = np.geomspace(1.0 / frequency[inner][-1], 1.0 / frequency[inner][0], KNOWN_PERIODS)
        profiles = [self._sine.basis_signals(np.array([period])) for period in periods]
        both = [
            np.concatenate([getattr(item, name) for item in profiles], axis=1)
            for name in ("interval_mean", "sample_value")
        ]
        for cause, effect in enumerate(effects):
            if 0.0 in (effect.lower, effect.upper):
                continue  # a one-sided effect cannot be a sine about zero
            sums = np.zeros((2, count))
            np.add.at(sums[0], index[:-1], interval_mean[:, cause])
            np.add.at(sums[1], index[1:], sample_value[:, cause])
            interval_sum, sample_sum = np.fft.rfft(sums, axis=1)[:, inner]
            # The mean of the sine over each interval acts on the states.
            turn = np.exp(-0.5j * angle * self._run.period_min) * np.sinc(frequency[inner] * self._run.period_min)
            total = interval_sum * turn + sample_sum
            squares = np.diag(signatures.gram(dynamics, cause, both[0][1:-1], both[1][2:])[1])
            b = 0.5 * squares.reshape(KNOWN_PERIODS, 2).sum(axis=1)
            b_of = np.exp(np.interp(np.log(1.0 / frequency[inner]), np.log(periods), np.log(np.maximum(b, 1e-300))))
            gain = np.abs(total) ** 2 / b_of
            best = int(np.argmax(gain))
            parameters = np.array([-total.imag[best], total.real[best], 0.0]) / b_of[best]
            parameters[2] = 1.0 / frequency[inner][best]
            candidates.append(Candidate(effect, self._sine, parameters, float(gain[best])))
        return candidates

    def _profile_candidates(
        self, dynamics: ErrorDynamics, effects: Sequence[Effect], profile: FittedProfile, shape: Array
    ) -> list[Candidate]:
        """All causes with one profile at given nonlinear parameters."""
        interval_mean, sample_value = profile.basis_signals(shape)[:2]
        candidates = []
        for cause, effect in enumerate(effects):
            if isinstance(profile, Sine) and 0.0 in (effect.lower, effect.upper):
                continue  # a one-sided effect cannot be a sine about zero
            a, b = signatures.gram(dynamics, cause, interval_mean[1:-1], sample_value[2:])
            if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
                continue
            # A one-sided effect keeps its sign. For other bounds see `_bounded_gain`.
            lowest, highest = (0.0 if end == 0.0 else inf for end in (effect.lower, effect.upper))
            if profile.name == self._free.name and 0.0 in (lowest, highest):
                gain, by = solve_bounded(b, a, np.full(a.size, -lowest), np.full(a.size, highest))
            else:
                by = np.asarray(np.linalg.lstsq(b, a, rcond=1e-12)[0], dtype=np.float64)
                gain = float(by @ (2.0 * a - b @ by))
            if profile.n_linear == 1:
                by, gains = _bounded_gain(by, a, b[0], effect)
                gain = float(gains[0])
            candidates.append(Candidate(effect, profile, np.append(by, shape), gain))
        return candidates


def first_of_each(items: Iterable[Item], kind: Callable[[Item], str]) -> list[Item]:
    """First item of each kind."""
    result: dict[str, Item] = {}
    for item in items:
        result.setdefault(kind(item), item)
    return list(result.values())


def _base(effect: Effect) -> Effect:
    return effect.effect if isinstance(effect, ConstantVariant) else effect


def _with_constants(item: Candidate) -> Candidate:
    """Candidate of the effect itself, with the constants of its variant."""
    if not isinstance(item.effect, ConstantVariant):
        return item
    parameters = np.append(item.parameters, item.effect.values)
    return replace(item, effect=item.effect.effect, parameters=parameters)


def all_finite(dynamics: ErrorDynamics) -> bool:
    """Return false about a run that has lost an unstable plant."""
    return all(bool(np.all(np.isfinite(item))) for item in (dynamics.w, dynamics.F, dynamics.G, dynamics.K))


def _best(a: Array, b: Array, effect: Effect) -> tuple[Array, Array]:
    """Most likely possible magnitudes and their gains."""
    size, gain = _bounded_gain(a / np.maximum(b, 1e-300), a, b, effect)
    good = np.isfinite(gain)
    return np.where(good, size, 0.0), np.where(good, gain, 0.0)


def _bounded_gain(size: Array, a: Array, b: Array, effect: Effect) -> tuple[Array, Array]:
    """Magnitudes within the effect's bounds, and their gains.

    Of a nonlinear effect the linear magnitude may be out of bounds though a possible one does the same: the less heat
    transfer remains, the more a further reduction does. So it keeps its gain, and a fit starts well inside the bounds.
    Beyond a bound of zero there is no magnitude to start with.
    """
    beyond = ((size < effect.lower) & (effect.lower < 0.0)) | ((size > effect.upper) & (effect.upper > 0.0))
    inside = np.clip(size, effect.lower, effect.upper)
    gain = np.where(beyond, size, inside) * (2.0 * a - np.where(beyond, size, inside) * b)
    return np.where(beyond, _WELL_INSIDE * inside, inside), gain
