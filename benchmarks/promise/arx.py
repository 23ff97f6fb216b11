"""The RLS ARX beside plain ARX and Shewhart: false events and faults found on plants that neither has seen.

The peer is what a statistician writes in twenty lines: an ARX model of each output by least squares on the training,
and a limit of its residuals from the normal distribution. Both are given the same rate, one false alarm in 14,400 rows;
the peer is shown once more with the lowest limits at which it raises as few false events as the RLS ARX. The plants are
three of others by their published equations (four tanks, TCLab's heaters, van de Vusse's reactor), the house's reactor
in a narrow range, and a linear plant with a dead time of each input.

    python -m benchmarks.promise --only arx [--seeds N]
"""

from collections.abc import Iterable, Mapping, Sequence
from math import inf, isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.stats import norm

import reactorwatch as rw
from benchmarks.harness.study import Pool, head, line, poisson_interval
from reactorwatch.arrays import Array
from reactorwatch.description.read import find_process
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import start_state
from reactorwatch.records.record import Record

PERIOD_MIN, RATE, MINUTES = 0.1, 30.0, 30 * 1440
"""Interval between rows as the monitor sees it, and false alarms promised in so many minutes: one in 14,400 rows."""

TRAINING, SOUND, BEFORE, FAULTY = 1000, 6000, 300, 400
"""Rows of the training, of a sound record after it, and of one with a fault before and after the onset."""

SETTLING, SAME_EVENT, FAULTS = 400, 30, 10
"""Rows before the record, rows between two points of one event, and records with a fault."""

SEED = 300
"""First seed; records of those before were looked at when the model was designed, or its table."""

CHARTS = ("shewhart", "ewma", "mewma")
"""Charts of residuals: the usual ones without `level`, which compares the plant with its training and not the model."""

FACTORS = np.geomspace(1.0, 5.0, 33)
"""Limits of the peer, in units of those for the stated rate."""

FOREIGN = Path(__file__).parents[1] / "inexact" / "processes"


class Plant(NamedTuple):
    """A plant: its process, true interval in minutes, ranges of its inputs, and noise of its outputs."""

    process: str
    period_min: float
    inputs: Mapping[str, tuple[float, float]]
    noise: Mapping[str, float]
    start: Mapping[str, float] = {}


_TANKS = {f"h{i}": 0.002 for i in (1, 2, 3, 4)}
PLANTS = {
    "four tanks": Plant(
        str(FOREIGN / "four_tanks.py"), 5 / 60, {"v1": (4.0, 9.0), "v2": (4.0, 9.0)}, _TANKS, dict.fromkeys(_TANKS, 0.2)
    ),
    "two heaters": Plant(
        str(FOREIGN / "tclab_simulator.py"),
        2 / 60,
        {"Q1": (10, 70), "Q2": (10, 70)},
        {"T1": 0.043, "T2": 0.043},
        dict.fromkeys(("H1", "H2", "T1", "T2"), 40.0),
    ),
    "van de Vusse": Plant(
        str(FOREIGN / "van_de_vusse.py"),
        18 / 60,
        {"F": (10.0, 25.0), "Q_dot": (-3000.0, -500.0)},
        {"C_b": 0.005, "T_R": 0.2, "T_K": 0.2},
        {"C_a": 2.0, "C_b": 1.0, "T_R": 120.0, "T_K": 118.0},
    ),
    "reactor, narrow": Plant("cstr", 0.1, {"qc": (100.0, 106.0)}, {"C": 0.002, "T": 0.3}),
    "dead times": Plant("", 0.1, {"u": (-1.0, 1.0), "v": (-1.0, 1.0)}, {"x": 0.05, "y": 0.05}),
}


class Job(NamedTuple):
    """A record to watch; fault 0 is none, the others take turns between a sensor's bias and an actuator's gain."""

    plant: str
    seed: int
    fault: int


class Result(NamedTuple):
    """Rows after the training, as JSON keeps them."""

    events: list[int]  # rows in which an alarm is raised while there is none
    alarms: list[int]  # rows in which any alarm is raised
    kept: bool
    instead: float  # number of false alarms at the rate that the monitor says can be kept
    of_peer: list[list[int]]  # rows beyond the limits, for each of the factors


def draw(job: Job) -> tuple[Array, Array]:
    """Draw inputs, shape (rows, inputs), and outputs, shape (rows, outputs), of a record."""
    plant, rng = PLANTS[job.plant], np.random.default_rng([job.seed, job.fault, 52])
    rows = SETTLING + TRAINING + (BEFORE + FAULTY if job.fault else SOUND)
    onset = SETTLING + TRAINING + BEFORE
    low, high = np.array(list(plant.inputs.values()), dtype=float).T
    inputs = np.column_stack([_levels(rng, rows) for _ in low]) * (high - low) + low
    inputs += 0.03 * (high - low) * _wander(rng, inputs.shape)
    actual = inputs.copy()
    if job.seed % 2:  # the inputs wander unseen, too
        actual += 0.015 * (high - low) * _wander(rng, inputs.shape)
    sds, bias = np.array(list(plant.noise.values())), np.zeros(len(plant.noise))
    sign = rng.choice((-1.0, 1.0))
    if job.fault % 2:
        bias[(job.fault // 2) % len(sds)] = sign * rng.uniform(6.0, 15.0)
    elif job.fault:
        actual[onset:, (job.fault // 2) % len(low)] *= 1.0 - rng.uniform(0.1, 0.2)  # within the range of each input
    outputs = _simulate(plant, actual) + sds * rng.standard_normal((rows, len(sds)))
    outputs[onset:] += sds * bias
    return inputs[SETTLING:], outputs[SETTLING:]


def _levels(rng: np.random.Generator, rows: int) -> Array:
    """Levels between 0 and 1 that are held for 60 to 240 rows."""
    holds = rng.integers(60, 240, rows // 60 + 1)
    return np.asarray(np.repeat(rng.uniform(size=holds.size), holds)[:rows])


def _wander(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """First-order Gauss-Markov signals of unit variance that forget in 20 rows."""
    kept = np.exp(-1.0 / 20.0)
    return np.asarray(lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], rng.standard_normal(shape), axis=0))


def _simulate(plant: Plant, inputs: Array) -> Array:
    """Outputs without noise; the equations start from rest at the first inputs."""
    if not plant.process:
        lagged = [np.concatenate([np.full(d, u[0]), u[:-d]]) for d, u in zip((4, 15), inputs.T, strict=True)]
        first, second = (lfilter([0.0, 1.0 - a], [1.0, -a], u) for a, u in zip((0.9, 0.8), lagged, strict=True))
        return np.column_stack([first + 0.5 * second, 0.7 * second - 0.4 * first])
    model = find_process(plant.process, 0).model
    assert model is not None
    order = [list(plant.inputs).index(name) for name in model.input_names]
    start = start_state(model, inputs[0, order], plant.start or "operating")
    outputs = Simulator(model).run(_times(len(inputs), plant.period_min), inputs[:, order], start).outputs
    columns = dict(zip(model.output_names, outputs.T, strict=True))
    return np.column_stack([columns[name] for name in plant.noise])


def _times(rows: int, period_min: float) -> Array:
    return np.asarray(np.arange(rows) * period_min, dtype=np.float64)


def watch(job: Job) -> Result:
    """Watch a record by both."""
    inputs, outputs = draw(job)
    names = [f"u{i}" for i in range(inputs.shape[1])], [f"y{i}" for i in range(outputs.shape[1])]
    columns = dict(zip((*names[0], *names[1]), (*inputs.T, *outputs.T), strict=True))
    found = rw.backtest(
        Record(_times(len(inputs), PERIOD_MIN), columns, job.plant),
        inputs=tuple(names[0]),
        outputs=tuple(names[1]),
        reference="arx",
        training_rows=TRAINING,
        false_alarms_per_30_days=RATE,
        charts=CHARTS,
    )
    spans = sorted((item.raised_min, item.cleared_min or inf) for item in found.alarms)
    events, end = [], -inf
    for raised_min, cleared_min in spans:
        if raised_min > end + SAME_EVENT * PERIOD_MIN:
            events.append(_row(raised_min))
        end = max(end, cleared_min)
    beyond = plain_arx(inputs, outputs)
    return Result(
        events,
        [_row(raised_min) for raised_min, _ in spans],
        found.promise is None or found.promise["kept"],
        (found.can_keep_per_30_days or 0.0) * (len(inputs) - TRAINING) * PERIOD_MIN / MINUTES,
        [np.flatnonzero(beyond > factor).tolist() for factor in FACTORS],
    )


def _row(time_min: float) -> int:
    return round(time_min / PERIOD_MIN) - TRAINING


def plain_arx(inputs: Array, outputs: Array) -> Array:
    """Largest residual of each row after the training, in units of its limit."""
    lags = [(inputs[3 - lag : -lag], outputs[3 - lag : -lag]) for lag in (1, 2, 3)]
    largest = np.zeros(len(outputs) - 3)
    limit = norm.isf(0.5 * RATE * PERIOD_MIN / MINUTES / outputs.shape[1])
    for i, y in enumerate(outputs[3:].T):
        past = [column for u, ys in lags for column in (u, ys[:, [i]])]
        x = np.column_stack([*past, np.ones(len(y))])
        theta = np.linalg.lstsq(x[: TRAINING - 3], y[: TRAINING - 3], rcond=None)[0]
        residual = y - x @ theta
        sd = residual[: TRAINING - 3].std(ddof=x.shape[1])
        largest = np.maximum(largest, np.abs(residual) / (limit * sd))
    return np.asarray(largest[TRAINING - 3 :])


def _first_of_each(rows: Iterable[int]) -> list[int]:
    """First rows of events: rows that are not within `SAME_EVENT` of the one before."""
    first, before = [], -SAME_EVENT - 1
    for row in rows:
        if row - before > SAME_EVENT:
            first.append(row)
        before = row
    return first


def print_table(pool: Pool, seeds: int, names: Sequence[str] = tuple(PLANTS)) -> None:
    """Watch sound and faulty records by both, and print the lines of each plant."""
    jobs = [Job(name, SEED + seed, 0) for name in names for seed in range(seeds)]
    jobs += [Job(name, SEED, fault) for name in names for fault in range(1, FAULTS + 1)]
    found = [(job, Result(*item)) for job, item in zip(jobs, pool.run("ARX", watch, jobs), strict=True)]
    print(head("plant", "method", "false events (95 %)", "promised", "found", "median delay, rows", "kept: events"))
    for name in (*names, "all"):
        sound = [item for job, item in found if not job.fault and name in (job.plant, "all")]
        faulty = [item for job, item in found if job.fault and name in (job.plant, "all")]
        promised = len(sound) * SOUND * PERIOD_MIN * RATE / MINUTES
        kept = [len(item.events) for item in sound if item.kept]
        broken = [item for item in sound if not item.kept]
        says = f"{len(kept)} of {len(sound)}: {sum(kept)}"
        if broken:
            says += (
                f"; else {sum(len(item.events) for item in broken)}, said {sum(item.instead for item in broken):.2g}"
            )
        count = sum(len(item.events) for item in sound)
        _print_line(name, "RLS ARX", count, promised, [item.alarms for item in faulty], says)
        of_peer = [sum(len(_first_of_each(item.of_peer[i])) for item in sound) for i in range(len(FACTORS))]
        equal = next((i for i, number in enumerate(of_peer) if number <= count), len(FACTORS) - 1)
        for i, text in ((0, "plain, at the same stated rate"), (equal, f"plain, limits {FACTORS[equal]:.2f} times")):
            _print_line(name, text, of_peer[i], promised, [item.of_peer[i] for item in faulty], "–")


def _print_line(
    name: str, method: str, count: int, promised: float, alarms: Sequence[Sequence[int]], says: str
) -> None:
    low, high = poisson_interval(count)
    delays = [min((row - BEFORE for row in rows if row >= BEFORE), default=inf) for rows in alarms]
    seen, median = sum(map(isfinite, delays)), float(np.median(delays))
    interval = f"{count} ({low:.1f} to {high:.1f})"
    print(
        line(name, method, interval, f"{promised:.1f}", f"{seen} of {len(delays)}", f"{median:.0f}", says), flush=True
    )
