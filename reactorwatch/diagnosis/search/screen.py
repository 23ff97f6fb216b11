"""Which causes, with which courses, come into question: all of them at once, linearised about a run of the filter.

Where a hypothesis has been fitted already, the run is that of its filter, and its own signature is added to what is
left: so rivals are asked to explain the same as it does, instead of it. About a good fit the linearisation holds, and
little noise of the process hides what tells rivals apart; about the nominal model that noise has taken up the
deviation, and the causes that stand out are all that can be asked for.

Effects that bring states of their own, such as a lag, have no infinitesimal deviation; for them see
`dynamic_effects_screen`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, log

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.augmented_model import with_size_inputs
from reactorwatch.diagnosis.fitting.bounded_least_squares import within
from reactorwatch.diagnosis.fitting.fault_filter import Sized, clipped, ways_between
from reactorwatch.diagnosis.fitting.hypothesis import Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, Course, Decay, Free, Ramp, Signal, Sine, Step
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.error_dynamics import ErrorDynamics, ErrorLinearization
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel

KNOTS = 12
DECAYS = (0.02, 0.1, 0.4)
"""Time constants of decays that are looked for, in spans of the record."""

SHORTEST_PERIOD_ROWS = 12
KNOWN_PERIODS = 10
"""For so many periods the size of a sine's signature is computed; between them it is interpolated."""

_WELL_INSIDE = 0.6

EDGE_ROWS = 5
"""Nearer to the ends of the record no onset is looked for."""

_INNER = slice(EDGE_ROWS, -EDGE_ROWS)


@dataclass(frozen=True, eq=False)
class Lead:
    """A cause with a course that may explain what is left.

    Attributes:
        effect: the cause.
        course: of its deviation.
        theta: where a fit may begin.
        gain: twice the logarithm of the likelihood ratio that the linear model promises.
    """

    effect: Effect
    course: Course
    theta: Array
    gain: float

    def score(self, values: int) -> float:
        """The gain in BIC."""
        return self.gain - self.course.freedom * log(values)


class Screen:
    """Looks for leads in a run.

    Args:
        model: of the plant.
        effects: the catalogue.
        run: the record.

    Attributes:
        effects: the catalogue.
        direct: effects that act on the model's own states.
        with_memory: the others.
    """

    def __init__(self, model: ProcessModel, effects: Sequence[Effect], run: Run) -> None:
        self._model, self._run, self.effects = model, run, tuple(effects)
        self._errors: dict[Sized, ErrorLinearization] = {}
        names = model.state_names
        self.direct = tuple(effect for effect in effects if effect.extend(model).state_names == names)
        self.with_memory = tuple(effect for effect in effects if effect not in self.direct)
        self._period_min = float(np.median(np.diff(run.time_min)))
        self._beta = np.diff(run.time_min[1:])
        t = run.time_min
        self._constant, self._step, self._ramp, self._decay = Constant(t), Step(t), Ramp(t), Decay(t)
        self._sine, self._free = Sine(t), Free(t, KNOTS)

    def leads(
        self, hypothesis: Hypothesis, fit: Fit, replaced: Sequence[int] = (), of: Sequence[Effect] | None = None
    ) -> list[Lead]:
        """The best of each cause and course, the most promising first.

        Args:
            hypothesis: about whose run all is linearised.
            fit: of it.
            replaced: places of those of its effects that rivals are looked for, to take their place; the others stay.
            of: these causes alone, of those in `direct`; None: all of them.
        """
        effects = self.direct if of is None else of
        with np.errstate(over="ignore", invalid="ignore"):  # about a run that has lost an unstable plant
            ways = self.ways_of_all(hypothesis, fit, replaced, effects)
            if not usable(ways):
                return []
            found = self._set_in(ways, effects) + self.swinging(ways, effects)
            found += self._in_course(ways, effects, self._free, np.empty(0))
            for place in replaced:
                course, theta = hypothesis.courses[place], fit.theta[place]
                if course.name != self._free.name:
                    found += self._in_course(ways, effects, course, theta[course.coefficients :])
        found = [item for item in found if np.isfinite(item.gain) and np.all(np.isfinite(item.theta))]
        return sorted(found, key=lambda item: -item.score(self._run.values))

    def ways_of_all(
        self, hypothesis: Hypothesis, fit: Fit, replaced: Sequence[int], of: Sequence[Effect] | None = None
    ) -> ErrorDynamics:
        """The equations of the filter's errors, of all effects in `direct`, with w as rivals have to explain it.

        Args:
            hypothesis: see `leads`.
            fit: likewise.
            replaced: likewise.
            of: likewise.
        """
        w = clipped(fit.w[2:])
        for place in replaced:
            w = w + self._explained(hypothesis, fit, place)
        effects = self.direct if of is None else of
        ways = self._ways(hypothesis.sized, hypothesis.signals(fit), fit, effects)
        return ErrorDynamics(ways.F, ways.G, ways.H, ways.D, ways.K, ways.whitening, w)

    def _explained(self, hypothesis: Hypothesis, fit: Fit, place: int) -> Array:
        """What a fitted deviation does to the innovations of a filter that does not know it, shape (rows, n_y)."""
        sized = hypothesis.sized
        if place == sized.late or sized.effects[place].is_discontinuous or sized.moves_clock(place):
            return clipped(hypothesis.without(self._run, fit, place)[2:]) - clipped(fit.w[2:])
        signals = hypothesis.signals(fit)
        ways = sized.ways(self._run, signals, fit.found)
        over_row, at_row = signals[place]
        return signatures.shown(ways, hypothesis.column(place), over_row[1:-1, None], at_row[2:, None])[:, :, 0]

    def _ways(self, sized: Sized, signals: Sequence[Signal], fit: Fit, effects: Sequence[Effect]) -> ErrorDynamics:
        """Of some effects about the run of a filter."""
        if sized.is_plain and all(effect in self.direct for effect in sized.effects):
            errors, inputs = self._among_all(sized, signals)
        else:
            errors, inputs = self._beside(sized), sized.inputs(self._run, signals)
        errors = errors.with_noise(sized.levels)
        errors.changes = sized.noise.times
        ways = ways_between(errors, self._run, inputs, fit.found, sized.used(self._run))
        columns = [self.direct.index(effect) for effect in effects]
        return ErrorDynamics(
            ways.F, ways.G[:, :, columns], ways.H, ways.D[:, :, columns], ways.K, ways.whitening, ways.w
        )

    def _among_all(self, sized: Sized, signals: Sequence[Signal]) -> tuple[ErrorLinearization, Array]:
        """A model with all direct effects in it, and its inputs: it is compiled once, whatever is in the filter."""
        of_all = with_size_inputs(self._model, self.direct)
        nothing = np.zeros(self._run.time_min.size)
        by_effect = dict(zip(sized.effects, signals, strict=True))
        sizes = [by_effect.get(effect, Signal(nothing, nothing)) for effect in self.direct]
        return of_all.errors, of_all.inputs(self._run.time_min, self._run.known_inputs, sizes)

    def _beside(self, sized: Sized) -> ErrorLinearization:
        """A filter's model with all direct effects beside those that are in it."""
        if sized not in self._errors:
            extended = sized.model
            rate_symbols, output_symbols = [], []
            for effect in self.direct:
                own = sized.size_symbols(effect)
                if own is None:
                    extended = effect.extend(extended)
                    own = (extended.parameters[-1].symbol,) * 2
                rate_symbols.append(own[0])
                output_symbols.append(own[1])
            self._errors[sized] = ErrorLinearization(extended, sized.levels, rate_symbols, output_symbols)
        return self._errors[sized]

    def _set_in(self, ways: ErrorDynamics, effects: Sequence[Effect]) -> list[Lead]:
        """Constants, steps, ramps and decays."""
        times, leads = self._run.time_min[1:-1], []
        constants = self._run.span_min * np.array(DECAYS)
        found = signatures.onsets(ways, *self._onset_laws(constants))
        for cause, effect in enumerate(effects):
            size, gain = _best(found.step_a[:, cause], found.step_b[:, cause], effect)
            leads.append(Lead(effect, self._constant, size[:1], float(gain[0])))
            place = EDGE_ROWS + int(np.argmax(gain[_INNER]))
            leads.append(Lead(effect, self._step, np.array([size[place], times[place]]), float(gain[place])))
            left_of_span = self._step.end_min - times  # from the slope of a ramp to the size that it has in the end
            ends = found.other_a[0, :, cause] / left_of_span
            size, gain = _best(ends, found.other_b[0, :, cause] / left_of_span**2, effect)
            place = EDGE_ROWS + int(np.argmax(gain[_INNER]))
            leads.append(Lead(effect, self._ramp, np.array([size[place], times[place]]), float(gain[place])))
            for number, constant in enumerate(constants.tolist(), start=1):
                size, gain = _best(found.other_a[number, :, cause], found.other_b[number, :, cause], effect)
                place = int(np.argmax(gain[:-EDGE_ROWS]))
                theta = np.array([size[place], times[place], constant])
                leads.append(Lead(effect, self._decay, self._decay.limited(theta, -np.inf, np.inf), float(gain[place])))
        return leads

    def _onset_laws(self, constants: Array) -> tuple[Array, Array, Array]:
        """Of a ramp and of decays, what `signatures.onsets` takes."""
        step = self._beta
        left = np.exp(-step / constants[:, None])
        beta = np.vstack([step, 1.0 - left])
        mean = np.vstack([0.5 * step, 1.0 - (1.0 - left) * constants[:, None] / step])
        return beta, np.vstack([np.ones_like(step), left]), mean

    def swinging(self, ways: ErrorDynamics, effects: Sequence[Effect]) -> list[Lead]:
        """The best sine of each cause whose ways these are."""
        over_row, at_row = signatures.sought(ways)
        rows = round(self._run.span_min / self._period_min) + 1
        place = np.round((self._run.time_min[1:] - self._sine.begin_min) / self._period_min).astype(int)
        count = 2 * rows
        frequency = np.fft.rfftfreq(count, self._period_min)
        inner = (frequency > 0.75 / self._run.span_min) & (frequency < 1.0 / (SHORTEST_PERIOD_ROWS * self._period_min))
        angle = 2.0 * np.pi * frequency[inner]
        leads = []
        known = np.geomspace(1.0 / frequency[inner][-1], 1.0 / frequency[inner][0], KNOWN_PERIODS)
        courses = [self._sine.basis(np.array([period])) for period in known]
        both = [np.concatenate([getattr(item, name) for item in courses], axis=1) for name in Signal._fields]
        for cause, effect in enumerate(effects):
            if 0.0 in (effect.lower, effect.upper):
                continue  # what is there to one side alone does not swing about nothing
            sums = np.zeros((2, count))
            np.add.at(sums[0], place[:-1], over_row[:, cause])
            np.add.at(sums[1], place[1:], at_row[:, cause])
            felt, seen = np.fft.rfft(sums, axis=1)[:, inner]
            # A row feels the mean of the sine from its time to the next one.
            turn = np.exp(-0.5j * angle * self._period_min) * np.sinc(frequency[inner] * self._period_min)
            total = felt * turn + seen
            squares = np.diag(signatures.products(ways, cause, both[0][1:-1], both[1][2:])[1])
            b = 0.5 * squares.reshape(KNOWN_PERIODS, 2).sum(axis=1)
            b_of = np.exp(np.interp(np.log(1.0 / frequency[inner]), np.log(known), np.log(np.maximum(b, 1e-300))))
            gain = np.abs(total) ** 2 / b_of
            best = int(np.argmax(gain))
            theta = np.array([-total.imag[best], total.real[best], 0.0]) / b_of[best]
            theta[2] = 1.0 / frequency[inner][best]
            leads.append(Lead(effect, self._sine, theta, float(gain[best])))
        return leads

    def _in_course(self, ways: ErrorDynamics, effects: Sequence[Effect], course: Course, shape: Array) -> list[Lead]:
        """All causes in one course with given numbers."""
        over_row, at_row = course.basis(shape)
        leads = []
        for cause, effect in enumerate(effects):
            a, b = signatures.products(ways, cause, over_row[1:-1], at_row[2:])
            if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
                continue
            # What is there to one side alone stays there. Of the rest see `_possible`.
            lowest, highest = (0.0 if end == 0.0 else inf for end in (effect.lower, effect.upper))
            if course.name == self._free.name and 0.0 in (lowest, highest):
                gain, by = within(b, a, np.full(a.size, -lowest), np.full(a.size, highest))
            else:
                by = np.asarray(np.linalg.lstsq(b, a, rcond=1e-12)[0], dtype=np.float64)
                gain = float(by @ (2.0 * a - b @ by))
            if course.coefficients == 1:
                by, gains = _possible(by, a, b[0], effect)
                gain = float(gains[0])
            leads.append(Lead(effect, course, np.append(by, shape), gain))
        return leads


def usable(ways: ErrorDynamics) -> bool:
    """Whether they are numbers: about a run that has lost an unstable plant they may not be."""
    return all(bool(np.all(np.isfinite(item))) for item in (ways.w, ways.F, ways.G, ways.K))


def _best(a: Array, b: Array, effect: Effect) -> tuple[Array, Array]:
    """The likeliest possible sizes and their gains."""
    size, gain = _possible(a / np.maximum(b, 1e-300), a, b, effect)
    good = np.isfinite(gain)
    return np.where(good, size, 0.0), np.where(good, gain, 0.0)


def _possible(size: Array, a: Array, b: Array, effect: Effect) -> tuple[Array, Array]:
    """Sizes within the effect's bounds, and their gains.

    Of an effect that is far from linear the linear size may be beyond what is possible though a possible one does the
    same: with much less heat transfer, less and less of it does ever more. So it keeps its gain, and a fit begins well
    inside. Beyond a bound of zero there is nothing to begin with.
    """
    beyond = ((size < effect.lower) & (effect.lower < 0.0)) | ((size > effect.upper) & (effect.upper > 0.0))
    inside = np.clip(size, effect.lower, effect.upper)
    gain = np.where(beyond, size, inside) * (2.0 * a - np.where(beyond, size, inside) * b)
    return np.where(beyond, _WELL_INSIDE * inside, inside), gain
