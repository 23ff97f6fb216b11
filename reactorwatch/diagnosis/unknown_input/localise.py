"""What no cause of the catalogue explains, but acts somewhere: where?

Each place is known by the effects of the catalogue that act there, and a balance by what is lost from it
(`unmodelled_loss`): how these push states and outputs is how anything else at that place would. So each is let go its
own way, as a forcing of unknown course (`forcing`), and the place whose forcing explains the run best is where it acts.
All are compared by the same likelihood, with as many numbers to choose.

First each is tried at a few levels about the path of the nominal filter; of the most promising places the best is then
given the levels that suit it, and its own path, in rounds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import log

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.diagnosis.fitting.fault_filter import loss_of
from reactorwatch.diagnosis.fitting.hypothesis import Fit
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.result import UnknownCourse
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import Explained
from reactorwatch.diagnosis.unknown_input.forcing import Fitted, Forcing, Levels, Linearised, Reference
from reactorwatch.diagnosis.unknown_input.unmodelled_loss import balance_losses
from reactorwatch.kalman.ekf import LEAST_PROCESS_SD, NoiseLevels
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel

MARGIN = 25.0
"""In BIC, over the best of the catalogue: a forcing may bend more."""

FIRST_REDS, FIRST_LASTS_MIN = (0.001, 0.03, 0.3, 3.0), (0.4, 3.0, 20.0)
"""Levels that are tried first: red noise in typical sizes of the effect, and how long it lasts."""

PLACES, FINALISTS = 5, 3
"""How many places are looked at more closely, and how many of them to the end."""

ROUNDS = 2
"""Of new paths for finalists."""

NUMBERS = 3
"""That a forcing has to choose beside the sensors' noise: how large its function and its red noise are, how long."""

LEAST_PROCESS_SHARE = 100.0 * LEAST_PROCESS_SD
"""Of a state's scale: what a path about which all is linear cannot say better."""

FAR_OFF = 6.0
"""Standard deviations of the nominal filter beyond which a value is an outlier."""

ANSWERED = 8.0
"""Standard deviations, of a correlation by chance."""

_REDS, _LASTS_MIN, _MOST_CHANGE = (1e-4, 30.0), (0.15, 300.0), 2.0
_COARSE, _FINE, _OF_SENSORS = 1.0, 0.5, 0.1  # steps of logarithms


@dataclass(frozen=True, eq=False)
class Located:
    """An effect at a place, that has no name.

    Attributes:
        effect: of the catalogue, or a loss from a balance, that pushes as it does.
        bic: as of a hypothesis with these numbers.
        size: of the effect, along the record.
        known: which values count in the BIC, shape (rows, n_y).
    """

    effect: Effect
    bic: float
    size: Signal
    known: NDArray[np.bool_]

    @property
    def course(self) -> UnknownCourse:
        """For people."""
        return UnknownCourse(self.effect.label, self.effect.unit, self.size.at_row)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A forcing as far as it has been fitted."""

    forcing: Forcing
    reference: Reference
    fitted: Fitted
    size: Signal


def located(
    model: ProcessModel, effects: Sequence[Effect], run: Run, nominal: Fit, noise: NoiseLevels
) -> Located | None:
    """Locate an effect that nothing explains; None if the run holds too little about it, or no place is known.

    Args:
        model: of the plant; uncertain parameters as the record has them.
        effects: the catalogue.
        run: the record.
        nominal: the filter's run without any effect.
        noise: that it took.
    """
    own = model.state_names
    carriers = [effect for effect in (*effects, *balance_losses(model)) if effect.extend(model).state_names == own]
    if input_answers(run, nominal):
        carriers = [effect for effect in carriers if not _shows_input(effect.extend(model))]
    if not carriers:
        return None
    reference = _reference(model, run, nominal)
    first = [_first(Forcing(model, effect), reference, run, noise) for effect in carriers]
    places = _best_of_places(first)[:PLACES]
    closer = _best_of_places([_closer(model, run, item, _COARSE) for item in places])[:FINALISTS]
    for _ in range(ROUNDS):
        closer = _best_of_places([_closer(model, run, item, _FINE) for item in closer])
    best = closer[0]
    if not np.isfinite(best.fitted.loss):
        return None
    bic = 2.0 * best.fitted.loss + NUMBERS * log(run.values)
    return Located(best.forcing.effect, bic, best.size, reference.known)


def input_answers(run: Run, nominal: Fit) -> bool:
    """Whether an input moves with what is measured in the same row, as that of a controller does.

    Then it tells of the sensors' noise in that row, and what shows an input in the outputs explains noise.
    """
    w = np.clip(np.nan_to_num(nominal.w[1:]), -FAR_OFF, FAR_OFF)
    changes = np.diff(run.inputs, axis=0)
    changes = changes - changes.mean(axis=0)
    both = np.abs(changes.T @ w)
    chance = np.sqrt(np.outer(np.sum(changes**2, axis=0), np.sum(w**2, axis=0)) / len(w))
    return bool(np.any(both > ANSWERED * chance))


def _shows_input(model: ProcessModel) -> bool:
    """Whether the outputs of a row depend on the input that holds from then on."""
    return any(ca.depends_on(output.expression, model.arguments()[1]) for output in model.outputs)


def bic_of(explained: Explained, known: NDArray[np.bool_], run: Run) -> float:
    """Of a hypothesis of the catalogue, by some of the values alone."""
    w, sd = explained.fit.w, explained.fit.found.conditional_sd
    counted = known & np.isfinite(w) & np.isfinite(sd)
    logs = float(np.sum(np.log(np.where(counted, sd, 1.0))))
    return 2.0 * (loss_of(np.where(counted, w, 0.0)) + logs) + explained.hypothesis.freedom * log(run.values)


def _reference(model: ProcessModel, run: Run, nominal: Fit) -> Reference:
    """The path of the nominal filter, which may know more states: of sensors, and of uncertain parameters."""
    own, rows = len(model.states), run.time_min.size
    x, P = nominal.found.x[:, :own], nominal.found.P[:, :own, :own]
    there = np.flatnonzero(np.all(np.isfinite(x), axis=1))
    x = np.stack([np.interp(np.arange(rows), there, column[there]) for column in x.T], axis=1)
    scales = np.array([state.scale for state in model.states])
    sure = np.all(np.isfinite(P.reshape(rows, -1)), axis=1)
    P = np.where(sure[:, None, None], P, np.diag(scales**2))
    began = np.zeros(rows, dtype=np.bool_)
    began[[0, *run.breaks]] = True
    known = np.isfinite(run.measured) & (np.abs(np.nan_to_num(nominal.w)) < FAR_OFF) & ~began[:, None]
    zero = np.zeros(rows)
    return Reference(x, Signal(zero, zero), LEAST_PROCESS_SHARE * scales, known, began, x, P)


def _first(forcing: Forcing, reference: Reference, run: Run, noise: NoiseLevels) -> _Trial:
    about = forcing.about(reference, run)
    tried = product(FIRST_REDS, FIRST_LASTS_MIN, range(len(about.clocks)))
    fits = [about.fit(Levels(red, lasts_min, noise.measurement_sd, clock)) for red, lasts_min, clock in tried]
    best = min(fits, key=lambda item: item.loss)
    return _Trial(forcing, reference, best, reference.size)


def _best_of_places(trials: Sequence[_Trial]) -> list[_Trial]:
    """The best of each place, the best first."""
    found: dict[str, _Trial] = {}
    for item in sorted(trials, key=lambda item: item.fitted.loss):
        found.setdefault(item.forcing.effect.location, item)
    return list(found.values())


def _closer(model: ProcessModel, run: Run, trial: _Trial, step: float) -> _Trial:
    """About the trial's path, with better levels, and the path that follows."""
    about = trial.forcing.about(trial.reference, run)
    fitted = _levelled(about, about.fit(trial.fitted.levels), step)
    if not np.isfinite(fitted.loss):
        return trial
    d, size = about.course(fitted)
    lower, upper = (np.array([getattr(state, name) for state in model.states]) for name in ("lower", "upper"))
    reference = replace(trial.reference, x=np.clip(trial.reference.x + d, lower, upper), size=size)
    return _Trial(trial.forcing, reference, fitted, size)


def _levelled(about: Linearised, best: Fitted, step: float) -> Fitted:
    """With better levels: each in turn goes to the bottom of the parabola through three of its values."""
    for place in range(2 + len(best.levels.sensor_sd)):
        h = step if place < 2 else _OF_SENSORS * step
        up, down = about.fit(_changed(best.levels, place, h)), about.fit(_changed(best.levels, place, -h))
        curved = up.loss + down.loss - 2.0 * best.loss
        by = 0.5 * h * (down.loss - up.loss) / curved if curved > 0.0 else float(np.sign(down.loss - up.loss)) * np.inf
        by = float(np.clip(by, -_MOST_CHANGE * h, _MOST_CHANGE * h))
        best = min(best, up, down, about.fit(_changed(best.levels, place, by)), key=lambda item: item.loss)
    return best


def _changed(levels: Levels, place: int, by: float) -> Levels:
    """With the logarithm of one changed, within reason."""
    factor = float(np.exp(by))
    if place == 0:
        return replace(levels, red=float(np.clip(levels.red * factor, *_REDS)))
    if place == 1:
        return replace(levels, lasts_min=float(np.clip(levels.lasts_min * factor, *_LASTS_MIN)))
    sds = list(levels.sensor_sd)
    sds[place - 2] *= factor
    return replace(levels, sensor_sd=tuple(sds))
