"""Generalised likelihood ratio of every cause at every onset, linearised about the filter's run, and its candidates.

For each cause, as a step and as a ramp that starts right after a row, `diagnosis.fitting.signatures` gives
a = sum(g w) and b = sum(g g), with w the normalised innovations and g the signature of a deviation of size 1. The
likeliest size is a / b, its variance 1 / b, and twice the logarithm of the likelihood ratio a^2 / b. One pass backwards
over the rows gives all onsets of all causes: 0.7 ms for 600 rows.

The signature is that of an infinitesimal size. A large fault soon leads the plant out of its range, so there are two
scans: of the rows up to the first at which some cause stands out, and of all.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from math import inf, log, nan, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from monitor_node.causes.window import BURN_IN_ROWS, Window
from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.augmented_model import augment_model
from reactorwatch.diagnosis.fitting.hypothesis import Fit
from reactorwatch.diagnosis.fitting.profiles import EndedRamp, FittedProfile, Ramp, Signal, Step
from reactorwatch.diagnosis.run import input_uncertainty_of
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.kalman.error_dynamics import ErrorDynamics
from reactorwatch.process.effect import Effect, SensorEffect
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import Memory


@dataclass(frozen=True, eq=False)
class Scan:
    """Result of a scan.

    Attributes:
        rows: number of rows of the scan.
        onset_min: onsets, shape (n,), increasing.
        size: the likeliest size, shape (n, profiles, causes).
        ratio: twice the logarithm of its likelihood ratio, same shape; minus infinity: not known.
        information: 1 / variance of the size, same shape.
    """

    rows: int
    onset_min: Array
    size: Array
    ratio: Array
    information: Array

    @property
    def stands_out(self) -> bool:
        """True if the likelihood ratio of some cause is that of more than noise."""
        return bool(np.max(self.ratio) > 60.0)


class GlrScan:
    """Scans windows of one plant."""

    def __init__(self, model: ProcessModel, noise: NoiseLevels, effects: Sequence[Effect]) -> None:
        self._lower = np.array([effect.lower for effect in effects])
        self._upper = np.array([effect.upper for effect in effects])
        self._augmented = augment_model(model, tuple(effects))
        self._errors = self._augmented.errors.with_noise(noise)

    def prepare(self) -> None:
        """Compile now what the first scan would compile."""
        self._errors.prepare()
        n_x, n_u, n_y = (len(item) for item in (self._errors.model.states, self._lower, self._errors.model.outputs))
        dynamics = ErrorDynamics(*(np.zeros((1, *shape)) for shape in ((n_x, n_x), (n_x, n_u), (n_y, n_x), (n_y, n_u))),
                    *(np.zeros((1, *shape)) for shape in ((n_x, n_y), (n_y, n_y), (n_y,))))  # fmt: skip
        self._scan_rows(np.array([0.0, 1.0]), dynamics, 0, 2)

    def scan(self, window: Window) -> tuple[Scan, Scan]:
        """Scan the rows up to the first in which a cause stands out, and all rows.

        Args:
            window: rows and the filter's run over them. Where the filter has diverged signatures may overflow; the
                ratio is then minus infinity.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            return self._scan_both(window)

    def _scan_both(self, window: Window) -> tuple[Scan, Scan]:
        times, first, rows, dynamics = window.time_min, BURN_IN_ROWS, window.time_min.size, self.dynamics(window)
        full = self._scan_rows(times, dynamics, first, rows)
        if not full.stands_out:
            return full, full
        early, most_without = full, first + 1  # the largest known number of rows in which nothing stands out
        while early.rows - most_without > 1:
            middle = self._scan_rows(times, dynamics, first, (early.rows + most_without) // 2)
            early, most_without = (middle, most_without) if middle.stands_out else (early, middle.rows)
        # a worse onset is out of question (twice a logarithm of a likelihood ratio)
        near = np.max(early.ratio, axis=(1, 2)) > np.max(early.ratio) - 30.0
        before = max(int(np.argmax(near)) - 1, 0)
        arrays = (full.onset_min, full.size, full.ratio, full.information)
        return early, Scan(rows, *(item[before:] for item in arrays))

    def dynamics(self, window: Window) -> ErrorDynamics:
        """Error dynamics of the filter about its run over the window, by the sizes of the effects.

        The constants of an effect have their nominal values: without the effect no row depends on them.
        """
        nothing = np.zeros(window.time_min.size)
        inputs = self._augmented.inputs(window.time_min, window.inputs, [Signal(nothing, nothing)] * self._lower.size)
        dynamics = self._errors.dynamics(
            window.time_min,
            inputs,
            window.x,
            window.covariance,
            window.residual,
            window.used,
            uncertainty=input_uncertainty_of(window, inputs),
        )
        of_sizes = np.s_[:, :, : self._lower.size]
        return replace(
            dynamics, G=np.ascontiguousarray(dynamics.G[of_sizes]), D=np.ascontiguousarray(dynamics.D[of_sizes])
        )

    def _scan_rows(self, times: Array, dynamics: ErrorDynamics, first: int, rows: int) -> Scan:
        """Scan the rows before index `rows` for onsets from the row `first` on."""
        part = slice(first, rows - 1)
        dynamics = ErrorDynamics(*(getattr(dynamics, item.name)[part] for item in fields(dynamics)))
        step = np.diff(times[first:rows])[None]
        both = signatures.onset_scan(dynamics, step, np.ones_like(step), 0.5 * step)
        a, b = (np.ascontiguousarray(np.swapaxes(item, 0, 1)) for item in both)
        size = a / np.maximum(b, 1e-300)
        # The linear size of a very nonlinear cause may be beyond a bound though a possible size does the same: the less
        # heat transfer, the more a reduction does. So it keeps its ratio; a size of the wrong sign has none.
        is_impossible = np.where(size < 0.0, self._lower == 0.0, self._upper == 0.0)
        ratio = np.where(is_impossible, 0.0, a * size)
        size = np.where(is_impossible, 0.0, size)
        return Scan(rows, times[part], size, np.where(np.isfinite(ratio), ratio, -np.inf), b)


BEHIND = 15.0
"""Log likelihood by which a hypothesis may be worse than the best one before it is dropped."""

MOST = 8
"""Maximum number of hypotheses of a small fault that are fitted."""

LEAST_GAIN = 5.0
"""Log likelihood that the end of a ramp has to gain: half the logarithm of some thousand values, and its onset's."""

PROFILES: tuple[type[FittedProfile], ...] = (Step, Ramp)
"""Profiles in the order of the scan."""

ALL_PROFILES: tuple[type[FittedProfile], ...] = (*PROFILES, EndedRamp)
"""Profiles that are fitted."""

_FIRST_ROWS = 6  # rows after the onset of the first fit to a large fault


@dataclass(frozen=True, eq=False)
class Candidate:
    """A cause with a profile, and its fit.

    Attributes:
        effect: effect of the cause.
        profile: kind of profile.
        parameters: size, for a ramp the size in the last row, onset, and for an ended ramp its end.
        gain: gain in log likelihood over a plant without a fault.
        w: normalised innovations of the newest rows, from before the onset on; 0 where nothing was measured.
        log_volume: logarithm of the posterior volume of sizes and onsets, relative to the prior's (see `isolation`).
        size_sd: standard deviation of the size.
        onset_sd_min: standard deviation of the onset.
        end_log_volume: logarithm of the posterior volume of a ramp's end, relative to the prior's; else 0.
        fit: result of the fit; None if it was not fitted.
    """

    effect: Effect
    profile: type[FittedProfile]
    parameters: Array
    gain: float
    w: Array = field(default_factory=lambda: np.empty((0, 0)))
    log_volume: float = 0.0
    size_sd: float = nan
    onset_sd_min: float = nan
    end_log_volume: float = 0.0
    fit: Fit | None = None

    @property
    def onset_min(self) -> float:
        """Onset in minutes."""
        return float(self.parameters[1])

    def residual(self, window: Window) -> tuple[Array, NDArray[np.bool_]]:
        """Normalised innovations since the onset, 0 where not measured, and a mask of measured values."""
        since = int(np.sum(window.time_min < self.onset_min)) - (window.time_min.size - len(self.w))
        w = self.w[max(since, 0) :]
        return w, np.isfinite(window.measured[window.time_min.size - len(w) :])

    def extrapolate(self, before_min: float, after_min: float) -> "Candidate":
        """Extend a ramp to rows that end at another time, with the same slope if its size stays possible."""
        if self.profile is not Ramp:
            return self
        size = self.parameters[0] * (after_min - self.onset_min) / max(before_min - self.onset_min, 1e-9)
        is_possible = self.effect.lower < size < self.effect.upper  # beyond, the filter may diverge
        return replace(self, parameters=np.array([size, self.onset_min])) if is_possible else self

    def end_trials(self, last_min: float) -> list["Candidate"]:
        """Ramps with the same slope that end elsewhere, and one that goes on until the last row."""
        if self.profile is Step:
            return []
        end_min = last_min if self.profile is Ramp else float(self.parameters[-1])
        slope, span = self.parameters[0] / max(end_min - self.onset_min, 1e-9), last_min - self.onset_min
        trials = [
            replace(self, profile=EndedRamp, parameters=np.array([slope * age, self.onset_min, self.onset_min + age]))
            for age in (share * span for share in (0.4, 0.6, 0.8, 0.95))
        ]
        going_on = replace(self, profile=Ramp, parameters=np.array([slope * span, self.onset_min]))
        return trials if self.profile is Ramp else [*trials, going_on]


class Lead(Memory):
    """A candidate as the next round of fits takes it up; parameters and gain as in `Candidate`."""

    cause: str
    profile: str
    parameters: list[float]
    gain: float


class Progress(Memory):
    """Progress of following a large fault. The object is its own state.

    Attributes:
        onset_min: approximate onset.
        end_min: time of the last row so far.
        rounds: number of rounds of fits so far.
        leads: the remaining candidates, best first.
    """

    onset_min: float
    end_min: float
    rounds: int
    leads: list[Lead]

    @classmethod
    def of(cls, onset_min: float, end_min: float, rounds: int, candidates: Iterable[Candidate]) -> "Progress":
        """The progress with these candidates."""
        leads = [Lead(item.effect.name, item.profile.name, item.parameters.tolist(), item.gain) for item in candidates]
        return cls(onset_min, end_min, rounds, leads)

    def candidates(self, effects: Sequence[Effect]) -> list[Candidate]:
        """The remaining candidates; none if a cause is not among the effects."""
        by_name, profiles = {item.name: item for item in effects}, {item.name: item for item in ALL_PROFILES}
        if not all(item.cause in by_name and item.profile in profiles for item in self.leads):
            return []
        return [
            Candidate(by_name[item.cause], profiles[item.profile], np.array(item.parameters), item.gain)
            for item in self.leads
        ]

    def is_of(self, stands_out_min: float, earliest_min: float) -> bool:
        """Return true if this is of the fault that stands out then, and the best onset is not before the earliest."""
        best = next((item.parameters[1] for item in self.leads), -inf)
        return earliest_min <= best and self.onset_min < stands_out_min <= self.end_min

    def next_end(self, times: Array) -> int:
        """Index after the last row of the next round; the more candidates remain, the fewer rows are added."""
        onset, end = np.searchsorted(times, (self.onset_min, self.end_min)).tolist()
        age = end + 1 - onset
        growth = 2 if age < 2 * _FIRST_ROWS or len(self.leads) > MOST else 4
        return int(min(onset + max(growth * age, _FIRST_ROWS), times.size))


def best_first(candidates: Iterable[Candidate]) -> list[Candidate]:
    """Sort by gain, largest first."""
    return sorted(candidates, key=lambda item: -item.gain)


def drop_needless_ends(candidates: list[Candidate]) -> list[Candidate]:
    """Candidates without the ended ramps that explain no more than a step of the same cause."""
    of_steps = {item.effect: item.gain for item in candidates if item.profile is Step}
    return [
        item
        for item in candidates
        if item.profile is not EndedRamp or item.gain > of_steps.get(item.effect, -inf) + LEAST_GAIN
    ]


def select_plausible(candidates: list[Candidate], share: float) -> list[Candidate]:
    """Candidates that are not worse than the first, the best, by more than `BEHIND` and a share of its gain."""
    least = candidates[0].gain - share * abs(candidates[0].gain) - BEHIND if candidates else 0.0
    return [item for item in candidates if item.gain >= least] or candidates[:1]  # a gain may be NaN


def scan_candidates(effects: Sequence[Effect], scan: Scan, window: Window) -> list[Candidate]:
    """Candidates of a scan with a positive finite gain, best first, each at its likeliest onset."""
    ratio = scan.ratio.reshape(scan.onset_min.size, -1)
    size, information = scan.size.reshape(ratio.shape), scan.information.reshape(ratio.shape)
    likeliest = np.argmax(ratio, axis=0)
    widths = np.gradient(scan.onset_min) if scan.onset_min.size > 1 else np.ones(1)
    highest = np.max(ratio, axis=0)
    density = np.exp(0.5 * (ratio - np.where(np.isfinite(highest), highest, 0.0))) * widths[:, None]
    distance = scan.onset_min[:, None] - scan.onset_min[likeliest]
    onset_sd_min = np.sqrt(np.sum(density * distance**2, axis=0) / np.maximum(np.sum(density, axis=0), 1e-300))
    values = _count_values_since(window, scan.onset_min)
    volume = np.sum(density / np.sqrt(1.0 + values)[:, None], axis=0) / window.onset_span_min
    log_volume = np.log(np.maximum(volume, 1e-300))
    end_min, candidates = float(window.time_min[scan.rows - 1]), []
    for column, row in enumerate(likeliest.tolist()):
        if information[row, column] > 0.0 and 0.0 < ratio[row, column] < inf:
            effect, profile = effects[column % len(effects)], PROFILES[column // len(effects)]
            onset_min = float(scan.onset_min[row])
            if profile is Step and isinstance(effect, SensorEffect):
                onset_min = interval_middle(window.time_min, onset_min)
            span = end_min - onset_min if profile is Ramp else 1.0
            final = float(size[row, column]) * span
            if not effect.lower <= final <= effect.upper:
                # well inside of its bound, where the linear size is beyond it
                final = 0.6 * min(max(final, effect.lower), effect.upper)
            parameters, gain = np.array([final, onset_min]), 0.5 * float(ratio[row, column])
            sds = span * float(information[row, column]) ** -0.5, float(onset_sd_min[column])
            candidates.append(
                Candidate(effect, profile, parameters, gain, np.empty((0, 0)), float(log_volume[column]), *sds)
            )
    return best_first(candidates)


def interval_middle(times: Array, onset_min: float) -> float:
    """Middle of the interval of an onset: a sensor's step shows in the next row wherever in the interval it occurs.

    An onset at the time of a row is taken to be right after it.
    """
    row = int(np.clip(np.searchsorted(times, onset_min, side="right"), 1, times.size - 1))
    return float(0.5 * (times[row - 1] + times[row]))


def _count_values_since(window: Window, onset_min: Array) -> Array:
    """Number of values measured since each onset."""
    counts = np.append(np.cumsum(np.sum(np.isfinite(window.measured), axis=1)[::-1])[::-1], 0)
    return np.asarray(counts[np.searchsorted(window.time_min, onset_min)])


def log_volume_of(candidate: Candidate, window: Window) -> float:
    """Logarithm of the posterior volume of a fit whose onset is about normal."""
    values = float(_count_values_since(window, np.array([candidate.onset_min]))[0])
    return log_share(candidate.onset_sd_min, window.onset_span_min) - 0.5 * log(1.0 + values)


def log_share(sd: float, span: float) -> float:
    """Logarithm of the volume of a normal density of height 1 relative to a uniform prior, at most 0."""
    return log(min(max(sqrt(2 * pi) * sd / span, 1e-300), 1.0))
