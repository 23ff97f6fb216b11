"""Posterior probabilities of the causes of an alarm, each with its size and onset.

Every cause of `causes` may occur as a step or as a ramp. A linearised scan (`scan`) selects the plausible ones and
their initial sizes and onsets, and the hypotheses of `diagnosis.fitting` are fitted to the rows. The result is the
posterior probability of each cause: of

    likelihood(size, onset) p(size) p(onset),

integrated over sizes and onsets, over that of all causes together. The prior of a size is normal and as wide as one
measurement would determine it (the unit information prior of Kass & Wasserman 1995, J. American Statistical Association
90), so that no cause is preferred for its unit: with n values since the onset the integral over the size is the maximum
likelihood over sqrt(1 + n). The prior of an onset is uniform. For a small fault the integral over the onset is a sum
over the scan's onsets; for a large one the onset is about normal, and the integral is Laplace's approximation. All
causes have the same prior probability, and so have the hypotheses that nothing is wrong and that the cause is none of
these.

*None of these* is weighed by the residual of the best cause. If innovations are larger by a factor than they should be,
row by row or in sums over some rows, the plant is more than its equations and this cause. But no plant is exactly its
equations, so that alone does not refute a cause. The amplitude of what is left, as a share of that of the deviation, is
normal about 0 with `INEXACT` if the equations err, and uniform if the cause is none of these. The evidence of causes is
divided by the factor then, as of values that are fewer by it. Nothing and none of these together are one suspect,
`UNKNOWN`.

Causes that imitate each other share the probability, as they should: these rows do not distinguish them.

A cause that adds a state, or is discontinuous, has no infinitesimal deviation, and is left to a diagnosis of the
record. A stuck sensor has a check of its own.

The linearised scan is accurate for a small fault: its best hypotheses are fitted to all rows. A large fault is followed
from where it is still small. The fit starts from the scan of the first rows, and the number of rows is multiplied from
round to round, so that each round starts near its optimum; hypotheses that fall behind on the way are dropped. Where
even the first rows do not gain what the scan predicts, smaller sizes are tried.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from math import exp, inf, isfinite, log, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from monitor_node.alarms.alarms import SuspectedCause
from monitor_node.causes.scan import (
    ALL_PROFILES,
    BEHIND,
    LEAST_GAIN,
    MOST,
    Candidate,
    GlrScan,
    Progress,
    Scan,
    best_first,
    drop_needless_ends,
    interval_middle,
    log_share,
    log_volume_of,
    scan_candidates,
    select_plausible,
)
from monitor_node.causes.window import Row, Window, newest_rows, window_of
from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.fitting.fault_filter import HUBER, FaultFilter
from reactorwatch.diagnosis.fitting.hypothesis import Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import EndedRamp, FittedProfile, Ramp, Step
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.batch import BudgetExceededError, FilterResult, StepBudget
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process import effects_of
from reactorwatch.process.effect import Effect, SensorEffect
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel
from reactorwatch.records.record import MINUTE_NS

UNKNOWN = "unknown"
"""Name of a cause that none of the causes here is; it has no size."""

SENSOR, PROCESS = "sensor", "process"
"""Kinds of causes."""


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def causes_of(model: ProcessModel) -> tuple[Effect, ...]:
    """Causes to which alarms of a plant with these equations are traced, of its own or generic effects.

    A source has no physical meaning, and noise no mean.
    """
    traced = (item for item in effects_of(model) if item.is_traced and item.has_derivative and not item.is_source)
    return tuple(effect for effect in traced if effect.extend(model).state_names == model.state_names)


def rank_suspects(candidates: Sequence[Candidate], misfit: "Misfit") -> list[SuspectedCause]:
    """Compute the probability of each cause, most likely first; its size and onset are those of its likeliest profile.

    Args:
        candidates: each cause with each profile, the best first; at least one.
        misfit: what the first leaves unexplained.
    """
    evidence = [log_evidence_of(item) / misfit.factor for item in candidates]
    top = max(*evidence, 0.0)
    weights = [exp(item - top) for item in evidence]
    odds = sqrt(2.0 / pi) / INEXACT * exp(-0.5 * (misfit.share / INEXACT) ** 2)
    explained = 1.0 - misfit.probability / (1.0 + odds)
    total = (sum(weights) + exp(-top)) / explained if explained > 0.0 else inf
    unknown = max(1.0 - sum(weights) / total, 0.0)
    suspects = [SuspectedCause(UNKNOWN, unknown)]
    for effect in dict.fromkeys(item.effect for item in candidates):
        indices = [index for index, item in enumerate(candidates) if item.effect is effect]
        item = candidates[max(indices, key=weights.__getitem__)]
        size, onset_min = item.parameters[:2].tolist()
        suspects.append(
            SuspectedCause(
                cause=effect.name,
                probability=sum(weights[index] for index in indices) / total,
                profile=(Step if item.profile is Step else Ramp).name,
                size=size,
                size_sd=item.size_sd,
                unit=effect.unit,
                onset_ns=round(onset_min * MINUTE_NS),
                onset_sd_min=item.onset_sd_min,
                kind=SENSOR if isinstance(effect, SensorEffect) else PROCESS,
                text=effect.describe(size),
            )
        )
    return sorted(suspects, key=lambda item: -item.probability)


def log_evidence_of(item: Candidate) -> float:
    """Logarithm of a candidate's likelihood ratio to no fault, integrated over sizes and onsets."""
    share = 1.0 - SHARE_OF_RAMPS if item.profile is Step else SHARE_OF_RAMPS
    return item.gain + item.log_volume + item.end_log_volume + log(share)


SHARE_OF_RAMPS = 0.3
"""Prior probability that a cause grows as a ramp, rather than as a step."""

LOOK_STEPS, LOOK_STEPS_A_ROW = 200_000, 200
"""Filter steps that a look may take: a fixed number, and a number for each usual row; 320,000 for 600 rows. The largest
faults of the catalogue take 290,000. A sensor with arbitrary values may take more: no cause explains it. The budget
does not depend on the sampling period: a step takes equally long in any interval, and the time of a look is limited. So
with rows some minutes apart the later looks at a large fault may stop where those with rows 0.1 min apart do not."""

LEAST_ROWS = 100
"""Minimum number of rows of a look at rows that are far apart, besides two for each row since the first alarm."""


class Isolation:
    """Compares all causes on rows of one plant.

    Attributes:
        steps: number of filter steps that a look may take.
        fitter: fits causes to the rows; its progress with a large fault is that of earlier looks.
        budget: budget of filter steps of the last look.
        stopped: true if the last look stopped at its budget.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, usual_rows: int = 600) -> None:
        self.steps = LOOK_STEPS + LOOK_STEPS_A_ROW * usual_rows
        self._nominal, effects = Filter(model, noise), causes_of(model)
        self._scan, self.fitter = GlrScan(model, noise, effects), Fitter(model, noise, effects)
        self.budget, self.stopped = StepBudget(1), False

    @property
    def preparations(self) -> list[Callable[[], None]]:
        """Functions that compile all that looks need, so that the first look takes as long as any other.

        Each takes some hundredths of a second for the first isolation of a model in this process.
        """
        return [self._nominal.prepare, self._scan.prepare, *self.fitter.preparations]

    def suspects(self, rows: Sequence[Row], since_rows: int = 0) -> list[SuspectedCause]:
        """Compute the plausible causes, most likely first, `UNKNOWN` among them.

        A look stops at a budget of filter steps. `UNKNOWN` is then the only suspect, and `stopped` is set.

        Args:
            rows: rows, oldest first.
            since_rows: number of rows since the first alarm. Of rows that are far apart older ones are left out, but
                not those in which the fault may have begun.
        """
        self.budget, self.stopped = StepBudget(self.steps), False
        try:
            return self._compare(newest_rows(rows, LEAST_ROWS + 2 * since_rows))
        except BudgetExceededError:  # fitted hypotheses cannot be compared with others that are not
            self.stopped = True
            return [SuspectedCause(UNKNOWN, 1.0)]

    def _compare(self, rows: Sequence[Row]) -> list[SuspectedCause]:
        self._nominal.budget = self.budget
        window = window_of(rows, self._nominal)
        if window is None:
            return [SuspectedCause(UNKNOWN, 1.0)]
        scans = self._scan.scan(window)
        candidates = [item for item in self.fitter.fit(window, *scans, self.budget) if isfinite(item.gain)]
        if not candidates:  # no measurement would show a cause, or every filter diverged
            return [SuspectedCause(UNKNOWN, 1.0)]
        return rank_suspects(candidates, misfit_of(candidates[0], window))


INEXACT = 0.2
"""Standard deviation of what equations err by, as a share of what a cause does: with constants off by 2 % and inputs
that wander, the right causes left 0 to 0.3 of four tanks, two heaters and a reactor. At 0.33 a cause and none of these
are equally likely; wrong ones left 0.33 or more, but for those that do nearly the same."""

SUMMED_ROWS = (1, 5, 20)
"""Numbers of rows over which innovations are summed: slow deviations show in long sums."""

TRAINING_VALUES = 500
"""Number of values by which the noise from the training counts when it is fitted to the rows."""

LARGEST_VARIANCE = 1.2
"""Largest ratio of the fitted variance to that of the training; training finds it to a few hundredths."""

_DUMMY_TIME_MIN = 0.1 * np.arange(4.0)

_LAST_STEPS = 8  # most steps of a fit to all rows
_HOLDS = 0.05  # share of its gain by which the linear estimate of a small fault may be off


class Fitter:
    """Fits all causes, each as a step and as a ramp.

    Attributes:
        progress: how far a large fault was followed; None without one.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, effects: Sequence[Effect]) -> None:
        self._model, self._noise = model, Noise(noise.measurement_sd, noise.process_sd)
        self._effects, self._filters = tuple(effects), dict[Effect, FaultFilter]()
        self._budget: StepBudget | None = None
        self.progress: Progress | None = None

    @property
    def preparations(self) -> list[Callable[[], None]]:
        """Functions that compile what the first fit of each cause would compile."""
        return [partial(self._prepare, effect) for effect in self._effects]

    def _prepare(self, effect: Effect) -> None:
        hypothesis = self.hypothesis(effect, Step(_DUMMY_TIME_MIN))
        hypothesis.filter.prepare()
        if effect is self._effects[0]:  # the kernels that all causes share: a fit to rows without measurements
            rows = _DUMMY_TIME_MIN.size
            outputs = np.full((rows, len(self._model.outputs)), np.nan)
            run = Run(_DUMMY_TIME_MIN, np.ones((rows, len(self._model.inputs))), outputs)
            hypothesis.fit(run, (_DUMMY_TIME_MIN[:2],), 1)

    def fit(self, window: Window, early: Scan, full: Scan, budget: StepBudget | None = None) -> list[Candidate]:
        """Fit the plausible causes; return them best first, followed for a small fault by those not fitted.

        Raises:
            BudgetExceededError: the budget is spent. The progress with a large fault is kept.
        """
        self._budget = budget
        best = scan_candidates(self._effects, full, window)
        if not best:
            return []
        best = [item for item in best if item.gain > (1.0 - _HOLDS) * best[0].gain - BEHIND]
        without_fault = self.run_without_fault(window).innovations
        segment = _Segment(self, window, 0, window.time_min.size, without_fault)
        predicted = best[0].gain
        gained = segment.loss_without_fault - segment.evaluate(best[0], best[0].parameters).loss
        if not abs(gained - predicted) < _HOLDS * predicted + 5.0:
            return self._follow(window, early, without_fault)
        fitted = best_first(segment.fit(item, first=True, steps=_LAST_STEPS) for item in best[:MOST])
        if misfit_of(fitted[0], window).log_evidence > 0.0:
            fitted = drop_needless_ends(best_first(segment.fit_end(item) for item in fitted))
        if len(best) <= MOST:  # a later look at more rows, in which the fault may be large, resumes from here
            end_min = float(window.time_min[-1])
            self.progress = Progress.of(fitted[0].onset_min, end_min, 1, select_plausible(fitted, 0.0))
        return [*(segment.add_deviations(item, item.onset_sd_min) for item in fitted), *best[MOST:]]

    def _follow(self, window: Window, early: Scan, without_fault: FilterResult) -> list[Candidate]:
        """Fit the plausible causes of a large fault, from where it is still small or from the last progress."""
        times, stands_out_min = window.time_min, float(window.time_min[early.rows - 1])
        progress, candidates = self.progress, list[Candidate]()
        if progress is not None and progress.is_of(stands_out_min, window.earliest_min):
            candidates = progress.candidates(self._effects)
        if progress is None or not candidates:
            candidates = select_plausible(scan_candidates(self._effects, early, window), 0.5)
            if not candidates:
                return []
            progress = Progress.of(candidates[0].onset_min, stands_out_min, 0, candidates)
            end = min(early.rows + 2, times.size)  # the latest onset is a row before the last
        else:
            end = progress.next_end(times)
        while end < times.size:
            segment, candidates = self._extend(progress, candidates, window, end, without_fault)
            first, end_min = progress.rounds == 0, float(times[end - 1])
            candidates = best_first(segment.fit(item, first=first, steps=3) for item in candidates)
            # The fewer rows a fit has seen, the farther it may be from its optimum.
            share = 0.5 if first else 0.1 if end_min - progress.onset_min < 100 * window.period_min else 0.05
            candidates = select_plausible(candidates, share)
            self.progress = progress = Progress.of(progress.onset_min, end_min, progress.rounds + 1, candidates)
            end = progress.next_end(times)
        segment, candidates = self._extend(progress, candidates, window, times.size, without_fault)
        if len(candidates) > MOST:
            candidates = sorted(candidates, key=lambda item: segment.evaluate(item, item.parameters).loss)[:MOST]
        if any(item.profile is not Step and segment.has_left(item, progress.end_min) for item in candidates[:2]):
            candidates = [segment.choose_end(item) for item in candidates]
        first = progress.rounds == 0
        candidates = best_first(segment.fit(item, first=first, steps=_LAST_STEPS) for item in candidates)
        candidates = drop_needless_ends(candidates)
        remaining = select_plausible(candidates, 0.5 if first else 0.05)
        self.progress = Progress.of(progress.onset_min, float(times[-1]), progress.rounds + 1, remaining)
        candidates = [segment.add_deviations(item) for item in select_plausible(candidates, 0.0)]
        return [replace(item, log_volume=log_volume_of(item, window)) for item in candidates]

    def _extend(
        self, progress: Progress, candidates: list[Candidate], window: Window, end: int, without_fault: FilterResult
    ) -> tuple["_Segment", list[Candidate]]:
        """Make the segment of the next round, and extrapolate the candidates to its end."""
        times = window.time_min
        earliest = int(np.searchsorted(times, min(item.onset_min for item in candidates)))
        begin = max(earliest - max(8, (end - earliest) // 4), 0)
        candidates = [item.extrapolate(progress.end_min, float(times[end - 1])) for item in candidates]
        return _Segment(self, window, begin, end, without_fault), candidates

    def hypothesis(self, effect: Effect, profile: FittedProfile) -> Hypothesis:
        """Hypothesis of a cause with a profile over some rows."""
        if effect not in self._filters:  # takes some milliseconds, and many causes are never plausible
            self._filters[effect] = FaultFilter(self._model, (effect,), self._noise)
        self._filters[effect].limit(self._budget)
        return Hypothesis(self._filters[effect], (profile,))

    def run_without_fault(self, run: Run, like: Fit | None = None) -> Fit:
        """Run of the filter of a plant without a fault; `like` is an earlier one over the same rows."""
        return self.hypothesis(self._effects[0], Step(run.time_min)).evaluate(run, _no_fault(run), like)


class _Segment:
    """Rows of a window on which hypotheses are compared."""

    def __init__(self, fitter: Fitter, window: Window, begin: int, end: int, without_fault: FilterResult) -> None:
        part, missing = slice(begin, end), window.missing
        self._fitter = fitter
        self._run = Run(
            window.time_min[part],
            window.inputs[part],
            window.measured[part],
            missing=None if missing is None else missing[part],
        )
        self._profiles = {kind: kind(self._run.time_min) for kind in ALL_PROFILES}
        for profile in self._profiles.values():  # of these profiles only the onset depends on the start
            # Before an onset the first row at least is shared, so the filter never starts again: that needs a search.
            profile.start_min = max(float(self._run.time_min[1]), window.earliest_min)
        own = FilterResult(*(item[part] for item in without_fault))
        like = Fit(_no_fault(self._run), 0.0, np.empty(0), own)
        self._like = fitter.run_without_fault(self._run, like)

    @property
    def loss_without_fault(self) -> float:
        """Loss of the filter without a fault."""
        return self._like.loss

    def _hypothesis(self, candidate: Candidate) -> Hypothesis:
        return self._fitter.hypothesis(candidate.effect, self._profiles[candidate.profile])

    def _like_of(self, candidate: Candidate) -> Fit:
        """Run without a fault, as a fit of the candidate's profile."""
        (parameters,) = _no_fault(self._run)
        return replace(self._like, parameters=(parameters[: self._profiles[candidate.profile].n_shape],))

    def evaluate(self, candidate: Candidate, parameters: Array) -> Fit:
        """Run the filter of a cause with this size and onset."""
        return self._hypothesis(candidate).evaluate(self._run, (parameters,), self._like_of(candidate))

    def _centre_onset(self, candidate: Candidate) -> Array:
        """Parameters with the onset of a sensor's step in the middle of its interval, away from both jumps."""
        size, onset_min = candidate.parameters[:2].tolist()
        if not (candidate.profile is Step and isinstance(candidate.effect, SensorEffect)):
            return candidate.parameters
        return np.array([size, interval_middle(self._run.time_min, onset_min)])

    def fit(self, candidate: Candidate, *, first: bool, steps: int) -> Candidate:
        """Fit a cause, starting from its parameters; in a first fit also from smaller sizes."""
        start = self._centre_onset(candidate)
        if first:
            at_start = self.evaluate(candidate, start)
            if self.loss_without_fault - at_start.loss < 0.5 * candidate.gain:
                smaller = (np.array([share * start[0], start[1]]) for share in (0.5, 0.2, 0.08))
                trials = [at_start, *(self.evaluate(candidate, parameters) for parameters in smaller)]
                start = min(trials, key=lambda item: item.loss).parameters[0]
        fit = self._hypothesis(candidate).fit(self._run, (start,), steps, self._like_of(candidate))
        gain = self.loss_without_fault - fit.loss
        return replace(candidate, parameters=fit.parameters[0], gain=gain, w=np.nan_to_num(fit.w), fit=fit)

    def has_left(self, candidate: Candidate, since_min: float) -> bool:
        """Return true if the plant no longer follows a candidate after a time: more than noise is left."""
        later = self._run.time_min > since_min
        w = self.evaluate(candidate, candidate.parameters).w[later]
        return misfit(np.nan_to_num(w), np.isfinite(self._run.measured[later])).log_evidence > 0.0

    def choose_end(self, candidate: Candidate) -> Candidate:
        """Let a ramp end elsewhere, with the same slope, if that explains the rows better as it is."""
        trials = candidate.end_trials(float(self._run.time_min[-1]))
        losses = [self.evaluate(item, item.parameters).loss for item in trials]
        own = self.evaluate(candidate, candidate.parameters).loss if trials else inf
        return trials[int(np.argmin(losses))] if min(losses, default=inf) < own - LEAST_GAIN else candidate

    def fit_end(self, candidate: Candidate) -> Candidate:
        """Fit the end of a ramp; return the candidate as it is if it does not gain by that."""
        (size, onset_min), end_min = candidate.parameters.tolist(), float(self._run.time_min[-1])
        if candidate.profile is not Ramp:
            return candidate
        start = np.array([0.8 * size, onset_min, onset_min + 0.8 * (end_min - onset_min)])
        ended = replace(candidate, profile=EndedRamp, parameters=start)
        fit = self.fit(ended, first=False, steps=_LAST_STEPS)
        return fit if fit.gain > candidate.gain + LEAST_GAIN else candidate

    def add_deviations(self, candidate: Candidate, first_sd_min: float = 0.0) -> Candidate:
        """Add the standard deviations of size and onset; that of the onset is at least `first_sd_min`."""
        assert candidate.fit is not None
        covariance = self._hypothesis(candidate).covariance(self._run, candidate.fit, first_sd_min)
        size_sd, onset_sd_min, *end_sds_min = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
        parameters, times = self._centre_onset(candidate), self._run.time_min
        end_log_volume = sum(log_share(sd, float(times[-1]) - float(parameters[1])) for sd in end_sds_min)
        # Within an interval only the interval's mean depends on the onset; for a sensor nothing does.
        within = float(np.interp(parameters[1], times[1:], np.diff(times))) / sqrt(12.0)
        onset_sd_min = max(onset_sd_min, first_sd_min, within)
        sds = {"size_sd": size_sd, "onset_sd_min": onset_sd_min}
        return replace(candidate, parameters=parameters, end_log_volume=end_log_volume, **sds)


def _no_fault(run: Run) -> tuple[Array]:
    """Parameters of any profile that is zero everywhere."""
    return (np.array([0.0, run.time_min[-1], run.time_min[-1]]),)


class Misfit(NamedTuple):
    """Part of a deviation that a cause does not explain.

    Attributes:
        log_evidence: logarithm of the evidence that its innovations are larger than noise by a factor, over that of
            noise.
        factor: the factor of their variance; 1 if there is no such evidence.
        share: amplitude of what is left, as a share of the deviation's, in innovations.
    """

    log_evidence: float
    factor: float
    share: float

    @property
    def probability(self) -> float:
        """Probability that they are larger than noise."""
        return 1.0 / (1.0 + exp(-self.log_evidence))


def misfit_of(candidate: Candidate, window: Window) -> Misfit:
    """Misfit of a cause since its onset."""
    return misfit(*candidate.residual(window), candidate.gain)


def misfit(w: Array, measured: NDArray[np.bool_], gain: float = 0.0) -> Misfit:
    """Misfit of a cause with these innovations.

    The variance of each sensor's noise is fitted to the rows, within the error of the training.

    Args:
        w: normalised innovations, 0 where not measured, shape (rows, n_y).
        measured: mask of measured values, same shape.
        gain: gain of the cause in log likelihood.
    """
    clipped, blocks = np.clip(w, -HUBER, HUBER), list[tuple[Array, NDArray[np.int_]]]()
    for rows in SUMMED_ROWS:
        full = len(w) // rows * rows
        counts = np.sum(measured[:full].reshape(-1, rows, w.shape[1]), axis=1)
        sums = np.sum(clipped[:full].reshape(-1, rows, w.shape[1]), axis=1)
        blocks.append((np.sum(sums**2 / np.maximum(counts, 1), axis=0), np.sum(counts > 0, axis=0)))
    squares, values = blocks[0]  # of single rows
    variance = np.clip((TRAINING_VALUES + squares) / (TRAINING_VALUES + values), 1 / LARGEST_VARIANCE, LARGEST_VARIANCE)
    best, factor = -inf, 1.0
    for squares, values in blocks:
        total, n = float(np.sum(squares / variance)), int(np.sum(values))
        if n > 0:
            larger = 0.5 * (total - n - n * log(total / n)) if total > n else 0.0
            best, factor = max(best, larger - 0.5 * log(n)), max(factor, total / n)
    log_evidence = (best if best > -inf else 0.0) - log(len(SUMMED_ROWS))
    beyond = max(0.5 * float(np.sum(blocks[0][0] / variance) - np.sum(blocks[0][1])), 0.0)
    share = sqrt(beyond / (gain + beyond)) if gain > 0.0 else 1.0
    return Misfit(log_evidence, factor if log_evidence > 0.0 else 1.0, share)
