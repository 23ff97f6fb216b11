"""How large each cause is and since when: the hypotheses, fitted to the rows.

All hypotheses run over the same rows and from the same state, that of the filter before any of them sets in.

The linearised bank is right about a small fault, so only the best few of its hypotheses are fitted then. A large fault
is followed from where it is still small. The fit begins with what the bank found in the first rows, and the rows that
it is fitted to are multiplied from round to round, so that it never has far to go; what falls behind on the way is left
behind. Where even that beginning does not keep what the bank promises, smaller sizes are tried. Asked again about the
same fault some rows later, the fit goes on from where it was.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from math import inf, isfinite, log, pi, sqrt

import numpy as np

from monitor_node.isolation.glr_scan import Scan
from monitor_node.isolation.hypothesis import SETTLED, Descent, Hypothesis
from monitor_node.isolation.segment import Stretch
from monitor_node.isolation.window import Window
from reactorwatch.arrays import Array
from reactorwatch.kalman.ekf import Filter, NoiseLevels
from reactorwatch.kalman.step_budget import StepBudget
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import RAMP, STEP
from reactorwatch.stored_state import StoredState

BEHIND = 15.0
"""In log likelihood: what is worse than the best by more is left behind."""

MOST = 8
"""Hypotheses about a small fault that are fitted."""

PROFILES = (STEP, RAMP)
"""In the order of the bank."""

_MARGIN_ROWS, _FIRST_ROWS = 8, 6
_STEPS, _LAST_STEPS = 3, 6
_SHRINKS = (0.5, 0.2, 0.08)
_HOLDS, _NOISE, _KEPT = 0.05, 5.0, 0.5


@dataclass(frozen=True, eq=False)
class Fit:
    """A hypothesis and what is known of it.

    Attributes:
        hypothesis: its number, see `Fitter`.
        size: of a step; of a ramp its slope, in a minute.
        onset_min: when it set in.
        gain: in log likelihood, against nothing being wrong.
        w: the whitened innovations of the newest rows, from before any hypothesis sets in; 0: not measured.
        log_volume: how much of what was possible beforehand is still, of all onsets and sizes; see `isolation`.
        size_sd: standard deviation of the size.
        onset_sd_min: of the onset.
        reached: size in the last row, of a ramp too.
        reached_sd: its standard deviation.
    """

    hypothesis: int
    size: float
    onset_min: float
    gain: float
    w: Array
    log_volume: float
    size_sd: float
    onset_sd_min: float
    reached: float
    reached_sd: float


class FitState(StoredState, frozen=True):
    """A fit on the way: the fields of `Fit`, its hypothesis by cause and profile, without `w`."""

    cause: str
    profile: str
    size: float
    onset_min: float
    gain: float
    log_volume: float
    size_sd: float
    onset_sd_min: float
    reached: float
    reached_sd: float


class WayState(StoredState, frozen=True):
    """How far a large fault has been followed: the fields of `_Way`."""

    stood_out_min: float
    onset_min: float
    until_min: float
    first: bool
    fits: list[FitState]


_STORED = [item.name for item in fields(Fit) if item.name not in ("hypothesis", "w")]


@dataclass(frozen=True, eq=False)
class _Way:
    """How far a large fault has been followed.

    Attributes:
        stood_out_min: when its first rows stood out.
        onset_min: about when it set in.
        until_min: up to where it was followed.
        first: whether that was the first round.
        fits: that were left, best first.
    """

    stood_out_min: float
    onset_min: float
    until_min: float
    first: bool
    fits: list[Fit]

    def leads_to(self, stood_out_min: float, earliest_min: float) -> bool:
        """Whether this is the way to where the same rows stood out, if something may set in from a time on."""
        return self.stood_out_min == stood_out_min and min(item.onset_min for item in self.fits) > earliest_min

    def further(self, window: Window) -> tuple[list[Fit], int]:
        """The fits that are not left behind, and the row before which to follow them next."""
        onset, end = np.searchsorted(window.time_min, (self.onset_min, self.until_min)).tolist()
        age = end + 1 - onset
        reached = onset + max((2 if age < 2 * _FIRST_ROWS else 4) * age, _FIRST_ROWS)
        # How far a fit can be from its best depends on how many rows it has seen; what it gains tells that best.
        best = self.fits[0]
        least = best.gain - (0.5 if self.first else 0.1) * abs(best.gain) - BEHIND
        fits = [item for item in self.fits if item.gain >= least] or [best]  # a gain may be no number
        return fits, min(reached, window.time_min.size)


class Fitter:
    """Fits all causes, each as a step and as a ramp.

    Args:
        model: of the plant.
        noise: of the plant and its sensors.
        effects: the causes, in the order of the bank.

    Attributes:
        hypotheses: of every cause the step, then of every cause the ramp.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, effects: Sequence[Effect]) -> None:
        self._nominal = Filter(model, noise)
        self.hypotheses = [Hypothesis(model, noise, effect, profile) for profile in PROFILES for effect in effects]
        self._way: _Way | None = None

    def forget(self) -> None:
        """Forget how far a fault has been followed."""
        self._way = None

    @property
    def state(self) -> WayState | None:
        """How far a fault has been followed: all that is remembered from one question to the next."""
        way = self._way
        if way is None:
            return None
        fits = []
        for fit in way.fits:
            of = self.hypotheses[fit.hypothesis]
            fits.append(FitState(of.effect.name, of.profile.name, **{name: getattr(fit, name) for name in _STORED}))
        return WayState(way.stood_out_min, way.onset_min, way.until_min, way.first, fits)

    def restore(self, state: WayState | None) -> None:
        """Go on from where another was; a cause that is not known here is left behind."""
        self.forget()
        if state is None:
            return
        places = {(item.effect.name, item.profile.name): place for place, item in enumerate(self.hypotheses)}
        fits = [
            Fit(places[item.cause, item.profile], w=np.empty((0, 0)), **{name: getattr(item, name) for name in _STORED})
            for item in state.fits
            if (item.cause, item.profile) in places
        ]
        if fits:
            self._way = _Way(state.stood_out_min, state.onset_min, state.until_min, state.first, fits)

    def fit(self, window: Window, early: Scan, whole: Scan, budget: StepBudget | None = None) -> list[Fit]:
        """The causes that come into question, likeliest first; of a small fault, then those that are not fitted.

        Args:
            window: the rows.
            early: what the linearised bank found in the rows up to the first at which a cause stands out.
            whole: what it found in all.
            budget: of the filter steps that the fit may take; None: as many as it needs.

        Raises:
            BudgetExceededError: the budget does not reach. How far a large fault has been followed is kept.
        """
        self._nominal.budget = budget
        best, rows = _begun(whole, window), window.time_min.size
        if not best:
            return []
        best = [item for item in best if item.gain > (1.0 - _HOLDS) * best[0].gain - BEHIND]
        stretch = Stretch(window, _begin(best[:MOST], window), rows, self._nominal)
        promised, likeliest = best[0].gain, self.hypotheses[best[0].hypothesis]
        kept = stretch.nothing.value - likeliest.loss(stretch, best[0].size, best[0].onset_min).value
        if not abs(kept - promised) < _HOLDS * promised + _NOISE:
            return self._followed(window, early)
        fits = []
        for item in best[:MOST]:
            fit = self._fitted(item, stretch, first=True, last=True)
            onset_sd_min = max(fit.onset_sd_min, item.onset_sd_min)
            fits.append(replace(fit, onset_sd_min=onset_sd_min, log_volume=item.log_volume))
        return [*sorted(fits, key=lambda item: -item.gain), *best[MOST:]]

    def _followed(self, window: Window, early: Scan) -> list[Fit]:
        """The same from where a large fault was still small, or from where it had been followed to before."""
        fits, reached, first = _begun(early, window), early.rows, True
        if not fits:
            return []
        onset_min, stood_out_min = fits[0].onset_min, float(window.time_min[early.rows - 1])
        if self._way is not None and self._way.leads_to(stood_out_min, window.earliest_min):
            onset_min, (fits, reached), first = self._way.onset_min, self._way.further(window), False
        while True:
            last = reached >= window.time_min.size
            stretch = Stretch(window, _begin(fits, window), reached, self._nominal)
            fits = [self._fitted(item, stretch, first=first, last=last) for item in fits]
            fits.sort(key=lambda item: -item.gain)
            self._way = _Way(stood_out_min, onset_min, stretch.end_min, first, fits)
            if last:
                return [replace(item, log_volume=_log_volume(item, window)) for item in fits]
            (fits, reached), first = self._way.further(window), False

    def _fitted(self, fit: Fit, stretch: Stretch, *, first: bool, last: bool) -> Fit:
        """Fitted to the rows of a stretch, from where it is."""
        nothing = stretch.nothing.value
        descent = Descent(self.hypotheses[fit.hypothesis], stretch)
        point = descent.at(fit.size, fit.onset_min)
        if first and nothing - point.loss < _KEPT * fit.gain:
            tried = [descent.at(share * fit.size, fit.onset_min) for share in _SHRINKS]
            point = min((point, *tried), key=lambda item: item.loss)
        slope, fresh = descent.slope(point, fit.size_sd), True
        for _ in range(_LAST_STEPS if last else _STEPS):
            nearer = descent.stepped(point, slope)
            gained, point = point.loss - nearer.loss, nearer
            if gained < SETTLED and fresh:
                break
            fresh = not (fresh and gained > SETTLED)
            if fresh:
                slope = descent.slope(point, slope.size_sd)
        onset_sd_min = inf
        if last:
            point, onset_sd_min = descent.onset(*descent.jumped(point, slope), slope)
        reached, reached_sd = descent.reached(point, slope)
        gain = nothing - point.loss
        found = (slope.size_sd, onset_sd_min, reached, reached_sd)
        return Fit(fit.hypothesis, point.size, point.onset_min, gain, point.w, fit.log_volume, *found)


def _begun(scan: Scan, window: Window) -> list[Fit]:
    """The hypotheses of a scan of which anything can be said, best first."""
    ratio = scan.ratio.reshape(scan.onset_min.size, -1)
    size, information = scan.size.reshape(ratio.shape), scan.information.reshape(ratio.shape)
    places = np.argmax(ratio, axis=0)
    widths = np.gradient(scan.onset_min) if scan.onset_min.size > 1 else np.ones(1)
    highest = np.max(ratio, axis=0)
    likely = np.exp(0.5 * (ratio - np.where(np.isfinite(highest), highest, 0.0))) * widths[:, None]
    off = scan.onset_min[:, None] - scan.onset_min[places]
    onset_sd_min = np.sqrt(np.sum(likely * off**2, axis=0) / np.maximum(np.sum(likely, axis=0), 1e-300))
    values = _values_since(window, scan.onset_min)
    volume = np.sum(likely / np.sqrt(1.0 + values)[:, None], axis=0) / window.span_min
    log_volume = np.log(np.maximum(volume, 1e-300))
    found = []
    for number, place in enumerate(places.tolist()):
        if information[place, number] > 0.0 and isfinite(ratio[place, number]):
            onset_min = float(scan.onset_min[place])
            is_ramp = PROFILES[number // (ratio.shape[1] // len(PROFILES))] is RAMP
            span = float(window.time_min[scan.rows - 1]) - onset_min if is_ramp else 1.0
            value, sd = float(size[place, number]), float(information[place, number]) ** -0.5
            gain, onset_sd = 0.5 * float(ratio[place, number]), float(onset_sd_min[number])
            known = (sd, onset_sd, value * span, sd * span)
            found.append(Fit(number, value, onset_min, gain, np.empty((0, 0)), float(log_volume[number]), *known))
    return sorted(found, key=lambda item: -item.gain)


def _values_since(window: Window, onset_min: Array) -> Array:
    """How many values were measured since each onset."""
    counts = np.append(np.cumsum(np.sum(np.isfinite(window.measured), axis=1)[::-1])[::-1], 0)
    return np.asarray(counts[np.searchsorted(window.time_min, onset_min)])


def _log_volume(fit: Fit, window: Window) -> float:
    """That of a fit whose onset is about normal."""
    values = float(_values_since(window, np.array([fit.onset_min]))[0])
    return log(min(sqrt(2 * pi) * fit.onset_sd_min / window.span_min, 1.0)) - 0.5 * log(1.0 + values)


def _begin(fits: Sequence[Fit], window: Window) -> int:
    """The row that hypotheses begin with: some rows before any of them sets in."""
    first = int(np.searchsorted(window.time_min, min(item.onset_min for item in fits)))
    return max(first - _MARGIN_ROWS, 0)
