"""Model selection: families and orders in one table, and the reason for the choice in one sentence.

The first half of the rows is fitted, the second held out. A model for monitoring must simulate well: the choice is by
its simulation of the held-out half. Fits that differ by less than half a percentage point count as equal, and of equals
the one with the fewest parameters is chosen.

BIC = N ln(S/N) + p ln N, with S the sum of squares of the residuals that the model was fitted by (Schwarz, Ann.
Statist. 6 (1978) 461), compares orders of one family, not families: those of an ARX model are one-step errors, those of
an output-error model simulation errors. With nearly noise-free data it always prefers higher orders: everything is
significant.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.linear import fit_linear
from reactorwatch.identification.linear_model import LinearModel, fit_percent, free_run_percent
from reactorwatch.identification.structure import Delay, Structure, as_columns

EQUAL_PERCENT = 0.5  # difference of fits that counts as none
LEAST_PERCENT = 20.0  # fit on the held-out half: with less no model is recommended (the mean alone has 0 %)


class Model(Protocol):
    """A fitted model. Signals are arrays of shape (rows,) or (rows, signals), NaN where nothing was measured."""

    @property
    def parameter_count(self) -> int:
        """Number of parameters."""

    def predict(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """One-step-ahead prediction, shape (rows, outputs); NaN where the rows before are incomplete."""

    def simulate(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """Simulation, shape (rows, outputs); NaN in the rows that it starts from."""

    def residuals(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """Measured minus predicted or simulated, as in the fit, shape (rows, outputs)."""


Fit = Callable[..., Model]
"""Fit of a model to a structure, inputs, outputs and time; raises InputError if they do not determine the model."""

LINEAR_FITS: Mapping[str, Fit] = {"arx": partial(fit_linear, "arx"), "oe": partial(fit_linear, "oe")}
"""Fits by the name of the family."""


class Candidate(msgspec.Struct, frozen=True):
    """A candidate, one row of the table.

    Attributes:
        family: name of the family.
        order: lags of output and input.
        parameters: number of parameters.
        one_step_percent: fit of the one-step prediction on the held-out half.
        free_run_percent: fit of the simulation on the held-out half; -inf if it diverged.
        bic: BIC on the fitted half; comparable within a family.
        refusal: reason why there is no such model; empty if there is one.
        delay: delay of the inputs in samples, or of each.
    """

    family: str
    order: int
    parameters: int = 0
    one_step_percent: float = math.nan
    free_run_percent: float = math.nan
    bic: float = math.nan
    refusal: str = ""
    delay: Delay = 1


@dataclass(frozen=True)
class Selection:
    """The table and the choice.

    Attributes:
        candidates: candidates in the order of delays, families and orders.
        chosen: the chosen candidate.
        model: model of the choice, fitted to the first half.
        reason: one sentence; where no model fits, the cause.
    """

    candidates: tuple[Candidate, ...]
    chosen: Candidate
    model: Model
    reason: str

    @property
    def fits(self) -> bool:
        """True where the chosen model is fit for use; otherwise it is the best of those that are not."""
        return self.chosen.free_run_percent >= LEAST_PERCENT

    def table(self) -> str:
        """The candidates as text, the chosen one marked."""
        delays = [_delay_text(candidate.delay) for candidate in self.candidates]
        width = max(map(len, ("delay", *delays))) + 2 if any(delay != "1" for delay in delays) else 0
        lines = [f"  family order{'delay' if width else '':>{width}}  parameters  one step %  free run %       BIC"]
        for candidate, delay in zip(self.candidates, delays, strict=True):
            mark = ">" if candidate is self.chosen and self.fits else " "
            head = f"{mark} {candidate.family:<6} {candidate.order:>5}{delay if width else '':>{width}}"
            if candidate.refusal:
                lines.append(f"{head}  {candidate.refusal}")
            else:
                percent = candidate.free_run_percent
                run = "diverges" if percent == -math.inf else f"{percent:.3f}"
                lines.append(
                    f"{head}  {candidate.parameters:>10}  {candidate.one_step_percent:>10.3f}"
                    f"  {run:>10}  {candidate.bic:>8.1f}"
                )
        return "\n".join(lines)


def select(
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None = None,
    fits: Mapping[str, Fit] = LINEAR_FITS,
    orders: Sequence[int] = (1, 2, 3),
    delays: Sequence[Delay] = (1,),
) -> Selection:
    """Fit every order and delay of every family to the first half of a record, and choose by the second.

    A plant that an ARX model shows to be unstable has no simulation: the ARX model with the smallest BIC is the choice,
    which does not fit for use.

    Args:
        inputs: shape (rows,) or (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows,) or (rows, 1), NaN where nothing was measured.
        time: shape (rows,); None: gaps are not detected.
        fits: fits to compare, by the name of the family.
        orders: orders to compare.
        delays: delays of the inputs to compare, each in samples, or of each input.

    Raises:
        InputError: no family, an order or delay below 1, or a record that no model can be fitted to.
    """
    u, y = as_columns(inputs, "inputs"), as_columns(outputs, "outputs", 1)
    if len(u) != len(y):
        raise InputError(f"inputs and outputs must have equally many rows, got {len(u)} and {len(y)}")
    t = np.arange(len(y), dtype=np.float64) if time is None else np.asarray(time, dtype=np.float64)
    half = len(y) // 2
    fitted: list[tuple[Candidate, Model]] = []
    candidates: list[Candidate] = []
    for delay, (family, fit), order in product(delays, fits.items(), orders):
        structure = Structure.of_order(order, delay, u.shape[1])
        try:
            model = fit(structure, u[:half], y[:half], t[:half])
        except InputError as refusal:
            candidates.append(Candidate(family, order, refusal=str(refusal), delay=structure.delay))
            continue
        held_out = u[half:], y[half:], t[half:]
        candidate = Candidate(
            family,
            order,
            model.parameter_count,
            fit_percent(y[half:, 0], model.predict(*held_out)[:, 0]),
            free_run_percent(model, y[half:, 0], model.simulate(*held_out)[:, 0]),
            bic(model.residuals(u[:half], y[:half], t[:half]), model.parameter_count),
            delay=structure.delay,
        )
        candidates.append(candidate)
        fitted.append((candidate, model))
    unstable = _unstable(candidates, fitted)
    if unstable is not None:
        return unstable
    judged = [pair for pair in fitted if math.isfinite(pair[0].free_run_percent)]
    if not judged:
        reasons = "; ".join(f"{c.family} {c.order}: {c.refusal or 'its simulation diverges'}" for c in candidates)
        raise UnfitRecordError(f"no model can be chosen: {reasons or 'no family or order was given'}")
    best = max(judged, key=lambda pair: pair[0].free_run_percent)[0]
    equal = [pair for pair in judged if pair[0].free_run_percent >= best.free_run_percent - EQUAL_PERCENT]
    chosen, model = min(equal, key=lambda pair: (pair[0].parameters, -pair[0].free_run_percent))
    selection = Selection(tuple(candidates), chosen, model, _reason(chosen, best, candidates))
    if selection.fits:
        return selection
    structure = Structure.of_order(chosen.order, chosen.delay, u.shape[1])
    return replace(
        selection,
        reason=f"no model fits: {describe(best)} runs best on the held-out half, with "
        f"{best.free_run_percent:.1f} % where the mean alone has 0 %; "
        f"{_why_none_fits(fits[chosen.family], structure, u, y, t)}",
    )


def describe(candidate: Candidate) -> str:
    """Family, order and delay of a candidate, for a sentence."""
    delay = _delay_text(candidate.delay)
    return f"{candidate.family} of order {candidate.order}{'' if delay == '1' else f' (delay {delay})'}"


def _delay_text(delay: Delay) -> str:
    return str(delay) if isinstance(delay, int) else ",".join(map(str, delay))


def _unstable(candidates: Sequence[Candidate], fitted: Sequence[tuple[Candidate, Model]]) -> Selection | None:
    """Choice for an unstable plant; None where the best ARX model shows none, or does not predict."""
    arx = [(c, model) for c, model in fitted if isinstance(model, LinearModel) and model.kind == "arx"]
    if not arx:
        return None
    best, model = min(arx, key=lambda pair: pair[0].bic)
    if not (model.instability and best.free_run_percent < 0.0 and best.one_step_percent >= LEAST_PERCENT):
        return None
    reason = (
        f"no model can be simulated, as the plant is unstable: {describe(best)} has {model.instability}, so a "
        "loop was closed while it was recorded, and a simulation along the recorded input diverges; "
        f"{describe(best)} has the smallest BIC and predicts the next row with {best.one_step_percent:.1f} %"
    )
    return Selection(tuple(candidates), best, model, reason)


def bic(residuals: ArrayLike, parameters: int) -> float:
    """Schwarz's criterion; smaller is better.

    Args:
        residuals: residuals of the fitted rows, NaN where missing.
        parameters: number of parameters.
    """
    values = np.asarray(residuals, dtype=np.float64)
    values = values[np.isfinite(values)]
    squares = float(values @ values)
    if values.size == 0 or squares == 0.0:
        return -math.inf
    return values.size * math.log(squares / values.size) + parameters * math.log(values.size)


def _why_none_fits(fit: Fit, structure: Structure, u: Array, y: Array, t: Array) -> str:
    """Difference between the halves of a record that explains why a model of the first does not simulate the second."""
    half = len(y) // 2
    before, after = u[:half][np.isfinite(u[:half]).all(axis=1)], u[half:][np.isfinite(u[half:]).all(axis=1)]
    margin = 0.1 * np.ptp(before, axis=0)
    lowest, highest = before.min(axis=0) - margin, before.max(axis=0) + margin
    unseen = float(np.mean(np.any((after < lowest) | (after > highest), axis=1)))
    if unseen > 0.05:
        return (
            f"{100 * unseen:.0f} % of the second half's inputs are out of the range of the first, which no model has "
            "seen: record a first half that moves as widely"
        )
    mean, later, spread = (float(value) for value in (np.nanmean(y[:half]), np.nanmean(y[half:]), np.nanstd(y[:half])))
    moved = (
        f"the output's mean went from {mean:.4g} to {later:.4g}, by {abs(later - mean) / max(spread, 1e-300):.1f} sd"
    )
    try:
        own = fit(structure, u[half:], y[half:], t[half:]).simulate(u[half:], y[half:], t[half:])
        percent = fit_percent(y[half:, 0], own[:, 0])
    except InputError:
        percent = -math.inf
    if percent >= 2.0 * LEAST_PERCENT:
        return (
            f"the halves differ: a model of the second half runs along it with {percent:.1f} %, and {moved}. In "
            "between lies a fault, a drift or another operating point: diagnose tells which; or identify each part"
        )
    return (
        f"a model of the second half alone does not run along it either, and {moved}: a drift, a disturbance that is "
        "not measured, noise, or a plant that is far from linear"
    )


def _reason(chosen: Candidate, best: Candidate, candidates: Sequence[Candidate]) -> str:
    name, percent = describe(chosen), chosen.free_run_percent
    if chosen is best:
        text = f"{name} runs best on the held-out half, {percent:.1f} %"
    else:
        text = (
            f"{name} is the smallest model whose simulation of the held-out half, {percent:.1f} %, is within "
            f"{EQUAL_PERCENT} of the best, {describe(best)} with {best.free_run_percent:.1f} %"
        )
    smallest = min(
        (c for c in candidates if c.family == chosen.family and not c.refusal), key=lambda candidate: candidate.bic
    )
    if smallest is chosen:
        return f"{text}, and BIC agrees."
    return f"{text}; BIC alone would take order {smallest.order}."
