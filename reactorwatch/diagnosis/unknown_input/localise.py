"""Localise a deviation that no effect of the catalogue explains.

Each location is represented by the catalogue's effects there, and a balance also by a loss from it (`_loss`):
anything else at that location acts on states and outputs as these do. Each effect gets a magnitude of unknown course
(`forcing`), and the location whose forcing explains the run best is the result. All are compared by the same
likelihood, with the same number of hyperparameters.

First each is evaluated at a few hyperparameters about the path of the nominal filter; then the hyperparameters and the
path of the most promising ones are optimised in rounds.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import log

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.diagnosis.fitting.hypothesis import Fit
from reactorwatch.diagnosis.fitting.profiles import Signal
from reactorwatch.diagnosis.result import UnknownInputCurve
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.screen import first_of_each
from reactorwatch.diagnosis.unknown_input.forcing import (
    Forcing,
    ForcingFit,
    Levels,
    LinearisedForcing,
    ReferenceTrajectory,
)
from reactorwatch.kalman.ekf_step import LEAST_PROCESS_SD, NoiseLevels
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel, Variable

FIRST_REDS, FIRST_LASTS_MIN = (0.001, 0.03, 0.3, 3.0), (0.4, 3.0, 20.0)
"""Initial grid: red noise in typical magnitudes of the effect, and its time constant."""

PLACES, FINALISTS = 5, 3
"""Locations that are refined, and how many of them to the end."""

ROUNDS = 2
"""Relinearisations of the finalists."""

NUMBERS = 3
"""Hyperparameters of a forcing beside the sensors' noise: sizes of its function and of its red noise, time constant."""

LEAST_PROCESS_SHARE = 100.0 * LEAST_PROCESS_SD
"""Fraction of a state's scale: a linearised path is no more accurate."""

FAR_OFF = 6.0
"""Standard deviations of the nominal filter beyond which a value is an outlier."""

ANSWERED = 8.0
"""Standard deviations of a chance correlation."""

_REDS, _LASTS_MIN, _MOST_CHANGE = (1e-4, 30.0), (0.15, 300.0), 2.0
_COARSE, _FINE, _OF_SENSORS = 1.0, 0.5, 0.1  # steps of the logarithms


@dataclass(frozen=True, eq=False)
class UnknownInput:
    """A localised deviation without a name.

    Attributes:
        effect: effect of the catalogue, or loss from a balance, that acts in the same way.
        bic: BIC as of a hypothesis with these hyperparameters.
        size: magnitude of the effect along the record.
        used: mask of values that count in the BIC, shape (rows, n_y).
        locations: BIC of each location over that of the best, the best first.
    """

    effect: Effect
    bic: float
    size: Signal
    used: NDArray[np.bool_]
    locations: dict[str, float]

    @property
    def curve(self) -> UnknownInputCurve:
        """Magnitude for the report."""
        return UnknownInputCurve(self.effect.label, self.effect.unit, self.size.sample_value)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A forcing with its present fit."""

    forcing: Forcing
    reference: ReferenceTrajectory
    fitted: ForcingFit
    size: Signal


def locate(
    model: ProcessModel, effects: Sequence[Effect], run: Run, nominal: Fit, noise: NoiseLevels
) -> UnknownInput | None:
    """Locate an unknown input; None if the run holds too little about it, or no location is known.

    Args:
        model: process model with the estimated values of uncertain parameters.
        effects: the catalogue.
        run: the record.
        nominal: fit without any effect.
        noise: noise levels of the filter.
    """
    own = model.state_names
    losses = (_loss(state) for state in model.states if state.balance)
    carriers = [effect for effect in (*effects, *losses) if effect.extend(model).state_names == own]
    if has_feedback(run, nominal):
        carriers = [effect for effect in carriers if not _has_feedthrough(effect.extend(model))]
    if not carriers:
        return None
    reference = _reference(model, run, nominal)
    first = [_try_levels(Forcing(model, effect), reference, run, noise) for effect in carriers]
    places = _best_by_location(first)[:PLACES]
    closer = _best_by_location([_refine(model, run, item, _COARSE) for item in places])[:FINALISTS]
    for _ in range(ROUNDS):
        closer = _best_by_location([_refine(model, run, item, _FINE) for item in closer])
    best = closer[0]
    if not np.isfinite(best.fitted.loss):
        return None
    bic = 2.0 * best.fitted.loss + NUMBERS * log(run.values)
    worse = {item.forcing.effect.location: 2.0 * (item.fitted.loss - best.fitted.loss) for item in closer}
    return UnknownInput(best.forcing.effect, bic, best.size, reference.used, worse)


def _loss(state: Variable) -> Effect:
    """Loss from a balance: it represents any deviation of the balance, for which the catalogue has no effect.

    A fraction of the content leaves, as with any outflow from a mixed vessel. Anything that enters a balance comes from
    a location of its own.
    """

    class Loss(Effect):
        """The share m a minute of what is there is lost; where m is negative, gained."""

        name = f"loss of {state.name}"
        label = f"unknown loss from the balance of {state.name}"
        location = state.balance
        unit = "1/min"
        lower = -10.0
        upper = 10.0
        typical = 0.03

        def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
            """See `Effect`."""
            return model.add_rate(state.name, -size * state.symbol)

    return Loss()


def has_feedback(run: Run, nominal: Fit) -> bool:
    """Return true if an input moves with the measurements of the same row, as that of a controller does.

    The input then contains the sensors' noise of that row, and an effect that feeds it to the outputs would explain
    noise.
    """
    w = np.clip(np.nan_to_num(nominal.w[1:]), -FAR_OFF, FAR_OFF)
    changes = np.diff(run.inputs, axis=0)
    changes = changes - changes.mean(axis=0)
    both = np.abs(changes.T @ w)
    chance = np.sqrt(np.outer(np.sum(changes**2, axis=0), np.sum(w**2, axis=0)) / len(w))
    return bool(np.any(both > ANSWERED * chance))


def _has_feedthrough(model: ProcessModel) -> bool:
    """Return true if the outputs of a row depend on the input that holds from then on."""
    return any(ca.depends_on(output.expression, model.arguments()[1]) for output in model.outputs)


def _reference(model: ProcessModel, run: Run, nominal: Fit) -> ReferenceTrajectory:
    """Path of the nominal filter, without its states for sensors and for uncertain parameters."""
    own, rows = len(model.states), run.time_min.size
    x, P = nominal.innovations.x[:, :own], nominal.innovations.P[:, :own, :own]
    there = np.flatnonzero(np.all(np.isfinite(x), axis=1))
    x = np.stack([np.interp(np.arange(rows), there, column[there]) for column in x.T], axis=1)
    scales = np.array([state.scale for state in model.states])
    sure = np.all(np.isfinite(P.reshape(rows, -1)), axis=1)
    P = np.where(sure[:, None, None], P, np.diag(scales**2))
    restarts = np.zeros(rows, dtype=np.bool_)
    restarts[[0, *run.breaks]] = True
    known = np.isfinite(run.measured) & (np.abs(np.nan_to_num(nominal.w)) < FAR_OFF) & ~restarts[:, None]
    zero = np.zeros(rows)
    return ReferenceTrajectory(x, Signal(zero, zero), LEAST_PROCESS_SHARE * scales, known, restarts, x, P)


def _try_levels(forcing: Forcing, reference: ReferenceTrajectory, run: Run, noise: NoiseLevels) -> _Trial:
    about = forcing.linearise(reference, run)
    tried = product(FIRST_REDS, FIRST_LASTS_MIN, range(len(about.clocks)))
    fits = [about.fit(Levels(red, lasts_min, noise.measurement_sd, clock)) for red, lasts_min, clock in tried]
    best = min(fits, key=lambda item: item.loss)
    return _Trial(forcing, reference, best, reference.size)


def _best_by_location(trials: Sequence[_Trial]) -> list[_Trial]:
    """Best trial of each location, the best first."""
    ordered = sorted(trials, key=lambda item: item.fitted.loss)
    return first_of_each(ordered, lambda item: item.forcing.effect.location)


def _refine(model: ProcessModel, run: Run, trial: _Trial, step: float) -> _Trial:
    """Relinearise, optimise the hyperparameters, and move to the resulting path."""
    about = trial.forcing.linearise(trial.reference, run)
    fitted = _optimise_levels(about, about.fit(trial.fitted.levels), step)
    if not np.isfinite(fitted.loss):
        return trial
    d, size = about.smooth_path(fitted)
    lower, upper = (np.array([getattr(state, name) for state in model.states]) for name in ("lower", "upper"))
    reference = replace(trial.reference, x=np.clip(trial.reference.x + d, lower, upper), size=size)
    return _Trial(trial.forcing, reference, fitted, size)


def _optimise_levels(about: LinearisedForcing, best: ForcingFit, step: float) -> ForcingFit:
    """Move each hyperparameter in turn to the minimum of a parabola through three of its values."""
    for index in range(2 + len(best.levels.sensor_sd)):
        h = step if index < 2 else _OF_SENSORS * step
        up, down = about.fit(_change(best.levels, index, h)), about.fit(_change(best.levels, index, -h))
        curved = up.loss + down.loss - 2.0 * best.loss
        by = 0.5 * h * (down.loss - up.loss) / curved if curved > 0.0 else float(np.sign(down.loss - up.loss)) * np.inf
        by = float(np.clip(by, -_MOST_CHANGE * h, _MOST_CHANGE * h))
        best = min(best, up, down, about.fit(_change(best.levels, index, by)), key=lambda item: item.loss)
    return best


def _change(levels: Levels, index: int, by: float) -> Levels:
    """Change the logarithm of one hyperparameter within its bounds."""
    factor = float(np.exp(by))
    if index == 0:
        return replace(levels, red=float(np.clip(levels.red * factor, *_REDS)))
    if index == 1:
        return replace(levels, lasts_min=float(np.clip(levels.lasts_min * factor, *_LASTS_MIN)))
    sds = list(levels.sensor_sd)
    sds[index - 2] *= factor
    return replace(levels, sensor_sd=tuple(sds))
