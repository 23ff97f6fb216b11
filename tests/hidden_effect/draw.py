"""Draws a record with something hidden in it, from a seed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import pi

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from reactorwatch.records.record import Record
from tests.hidden_effect.catalogue import CATALOGUE, HiddenEffect, open_constants
from tests.hidden_effect.courses import Array, HiddenCourse
from tests.hidden_effect.excitation import Circumstances, Handling, handling
from tests.hidden_effect.plant import Plan, Played, play

LEAST_STRENGTH = 300.0
"""See `Hidden.strength`; less is not worth finding in a record."""

COLDEST_K, HOTTEST_K = 405.0, 485.0
"""On its operating branch the reactor stays in between."""

TRIES = 40
RANDOM_HEAT_STEP_MIN, RANDOM_HEAT_CORRELATION_MIN = 0.05, 2.0


@dataclass(frozen=True, eq=False)
class Hidden:
    """A record and the truth about it.

    Attributes:
        record: what was measured.
        seed: that it was drawn from.
        circumstances: under which.
        effects: that are hidden in it; none: the nominal plant.
        courses: of each.
        strength: by how much the log likelihood of the white sensors' noise grows, twice, where the simulation knows
            the truth: the sum of squares of what the outputs differ by, in standard deviations of the noise.
        played: what happened in the plant, without noise.
        shown: what the sensors of C and T would have shown in the rows of the record without noise, shape (rows, 2).
    """

    record: Record
    seed: int
    circumstances: Circumstances
    effects: tuple[HiddenEffect, ...]
    courses: tuple[HiddenCourse, ...]
    strength: float
    played: Played
    shown: Array

    @property
    def causes(self) -> tuple[str, ...]:
        """Names of the effects, sorted."""
        return tuple(sorted(effect.name for effect in self.effects))


class CannotHideError(ValueError):
    """An effect cannot be hidden under some circumstances: it would show too little, or put the reactor out."""


def draw(
    seed: int,
    effects: Sequence[HiddenEffect] = (),
    circumstances: Circumstances = Circumstances(),  # noqa: B008 # it is frozen
    kinds: Sequence[str] | None = None,
    may_leave_branch: bool = False,
) -> Hidden:
    """A record in which some effects are hidden.

    Args:
        seed: of everything that is random.
        effects: to be hidden.
        circumstances: under which it is recorded.
        kinds: of the courses, one an effect; None: drawn.
        may_leave_branch: whether the reactor may go out.

    Raises:
        CannotHideError: no size of the effect shows in the record and leaves the reactor on its branch.
    """
    rng = np.random.default_rng([seed, 20])
    done = handling(circumstances, rng)
    noise = _noise(circumstances, done.time_min.size, rng)
    plan = replace(_plan(circumstances, done, noise, seed), deviations=_background(circumstances, effects, seed))
    nominal = play(plan)
    if not effects:
        record, shown = _record(plan, nominal, noise, circumstances, rng)
        return Hidden(record, seed, circumstances, (), (), 0.0, nominal, shown)
    for _ in range(TRIES):
        courses = tuple(
            _course(effect, None if kinds is None else kinds[place], done.time_min, rng)
            for place, effect in enumerate(effects)
        )
        hidden = {effect.name: course for effect, course in zip(effects, courses, strict=True)}
        trial = replace(plan, deviations={**plan.deviations, **hidden})
        played = play(trial)
        if not (may_leave_branch or _on_branch(played, circumstances)):
            continue
        if min(_strengths(trial, played, tuple(hidden), circumstances.noise_sd)) >= LEAST_STRENGTH:
            strength = _strength(trial, played, plan.deviations, circumstances.noise_sd)
            record, shown = _record(trial, played, noise, circumstances, rng)
            return Hidden(record, seed, circumstances, tuple(effects), courses, strength, played, shown)
    names = " and ".join(effect.name for effect in effects)
    raise CannotHideError(f"seed {seed}: {names} shows too little under {circumstances}, or puts the reactor out")


def _plan(circumstances: Circumstances, done: Handling, noise: Array, seed: int) -> Plan:
    start = {"settled": None, "middle": (0.470, 402.0), "extinguished": (0.964, 353.55)}[circumstances.start]
    return Plan(
        done.time_min,
        done.command,
        constants=open_constants(),
        interpolated=circumstances.interpolated,
        controller=done.controller,
        set_point_K=done.set_point_K,
        measured_noise_K=noise[:, 1],
        process_sd=circumstances.process_sd,
        seed=seed,
        start=start,
    )


def _background(circumstances: Circumstances, effects: Sequence[HiddenEffect], seed: int) -> dict[str, HiddenCourse]:
    """Constant deviations that make a plant differ a little from the model, other than those that are hidden."""
    if not circumstances.background:
        return {}
    rng = np.random.default_rng([seed, 21])
    others = [item for item in CATALOGUE if item not in effects and "sine" in item.courses]
    chosen = rng.choice(len(others), size=2, replace=False)
    sizes = ((others[i], float(rng.choice(others[i].signs)) * circumstances.background) for i in chosen)
    return {item.name: HiddenCourse("constant", share * item.smallest) for item, share in sizes}


def _on_branch(played: Played, circumstances: Circumstances) -> bool:
    if circumstances.start != "settled":
        return bool(np.all(np.isfinite(played.state)))
    T = played.state[:, 1]
    return bool(T.min() > COLDEST_K and T.max() < HOTTEST_K)


def _course(effect: HiddenEffect, kind: str | None, time_min: Array, rng: np.random.Generator) -> HiddenCourse:
    """A course of an effect: its kind, size and times."""
    kind = str(rng.choice(effect.courses)) if kind is None else kind
    begin, end = float(time_min[0]), float(time_min[-1])
    span = end - begin
    size = float(np.exp(rng.uniform(np.log(effect.smallest), np.log(effect.largest))) * rng.choice(effect.signs))
    if effect.name == "random_heat":
        return _random(size, begin, end, rng)
    onset = begin + span * float(rng.uniform(0.15, 0.7))
    match kind:
        case "constant":
            return HiddenCourse(kind, size)
        case "step":
            return HiddenCourse(kind, size, onset)
        case "ramp":
            onset = begin + span * float(rng.uniform(0.1, 0.6))
            return HiddenCourse(kind, size, onset, end_min=end)
        case "decay":
            constant = span * float(np.exp(rng.uniform(np.log(0.02), np.log(0.3))))
            return HiddenCourse(kind, size, onset, time_constant_min=constant)
        case "sine":
            period = float(np.exp(rng.uniform(np.log(min(5.0, span / 10.0)), np.log(span / 3.0))))
            return HiddenCourse(kind, abs(size), begin, period_min=period, phase_rad=float(rng.uniform(-pi, pi)))
        case "pulses":
            return HiddenCourse(kind, size, begin, period_min=float(rng.uniform(4.0, 15.0)))
        case _:
            return _curve(size, len(effect.signs) == 1, begin, end, rng)


def _curve(size: float, one_sided: bool, begin: float, end: float, rng: np.random.Generator) -> HiddenCourse:
    """A smooth curve through random values, or a straight line between them; largest at `size`."""
    count = int(rng.integers(5, 8))
    values = rng.uniform(0.0, 1.0, count) if one_sided else rng.uniform(-1.0, 1.0, count)
    knots = np.linspace(begin, end, count)
    if rng.random() < 0.5:
        fine = np.linspace(begin, end, 301)
        knots, values = fine, CubicSpline(knots, values)(fine)
        values = np.maximum(values, 0.0) if one_sided else values
    return HiddenCourse("free", size, knots_min=knots, values=values * (size / np.max(np.abs(values))))


def _random(size: float, begin: float, end: float, rng: np.random.Generator) -> HiddenCourse:
    """Red noise of a standard deviation: an Ornstein-Uhlenbeck process."""
    knots = np.arange(begin, end + RANDOM_HEAT_STEP_MIN, RANDOM_HEAT_STEP_MIN)
    kept = np.exp(-RANDOM_HEAT_STEP_MIN / RANDOM_HEAT_CORRELATION_MIN)
    drawn = rng.standard_normal(knots.size) * np.sqrt(1.0 - kept**2)
    return HiddenCourse("free", size, knots_min=knots, values=size * lfilter([1.0], [1.0, -kept], drawn))


def _noise(circumstances: Circumstances, rows: int, rng: np.random.Generator) -> Array:
    """Noise of the sensors of C and T, shape (rows, 2)."""
    drawn = rng.standard_normal((rows, 2))
    kept = circumstances.correlation
    if kept:
        drawn = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], drawn, axis=0)
    return np.asarray(drawn * np.array(circumstances.noise_sd))


def _record(
    plan: Plan, played: Played, noise: Array, circumstances: Circumstances, rng: np.random.Generator
) -> tuple[Record, Array]:
    """Measurements of a run, and their noise-free values."""
    shown = np.stack([played.concentration, played.temperature], axis=1)
    values = shown + noise
    if circumstances.outliers:
        off = rng.random(values.shape) < circumstances.outliers
        far = rng.uniform(10.0, 30.0, values.shape) * rng.choice([-1.0, 1.0], values.shape)
        values = values + np.where(off, far * np.array(circumstances.noise_sd), 0.0)
    for column, resolution in enumerate(circumstances.resolution):
        if resolution:
            values[:, column] = np.round(values[:, column] / resolution) * resolution
    if circumstances.missing_values:
        values[rng.random(plan.time_min.size) < circumstances.missing_values] = np.nan
    there = np.ones(plan.time_min.size, dtype=bool)
    if circumstances.missing:
        there = rng.random(plan.time_min.size) >= circumstances.missing
        there[0] = True
    columns = {"qc": played.qc[there], "C": values[there, 0], "T": values[there, 1]}
    return Record(plan.time_min[there], columns, f"hidden effect, seed {plan.seed}"), shown[there]


def _strengths(plan: Plan, played: Played, names: Sequence[str], noise_sd: tuple[float, float]) -> list[float]:
    """Strength of some effects of a plan, each beside the others."""
    found = []
    for name in names:
        others = {other: course for other, course in plan.deviations.items() if other != name}
        found.append(_strength(plan, played, others, noise_sd))
    return found


def _strength(plan: Plan, played: Played, others: Mapping[str, HiddenCourse], noise_sd: tuple[float, float]) -> float:
    """Error of a simulation with only some of the deviations, fed with the record's qc."""
    fed = replace(plan, command=played.qc, controller=None, deviations=others)
    if plan.controller is not None and fed.start is None:
        fed = replace(fed, start=(float(played.state[0, 0]), float(played.state[0, 1])))
    told = play(fed)
    sd = noise_sd
    off = np.minimum(((told.concentration - played.concentration) / sd[0]) ** 2, 1e4) + np.minimum(
        ((told.temperature - played.temperature) / sd[1]) ** 2, 1e4
    )
    return float(np.sum(off))
