"""Chart on parameters: cost a row, rate of false alarms, and effect of a plant at rest.

Cost: in the single form. Goal: 3 microseconds.
False alarms: of a first-order ARX plant with AR(1) noise, as a multiple of the number promised. Omega of the covariance
is learned by cosines as in `reactorwatch.spc.parameter_drift`; with the weights of Newey & West at the bandwidth 1.3
sqrt(rows), its degrees of freedom 1.5 rows over that; and as the textbook has it, s^2 H. At rest: the reactor with
noise, trained on steps of the coolant flow; the largest T2 over its limit afterwards.
"""

import time
from math import sqrt

import numpy as np
from scipy import signal

from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.simulate import Simulator
from reactorwatch.spc import parameter_drift
from reactorwatch.spc.charts.base import Array
from reactorwatch.spc.charts.parameters import ParameterT2
from reactorwatch.spc.run_length.parameters import parameter_limit

NAMES = ["a1", "b1", "c"]
FORGETTING, WEIGHT, ARL0 = 0.99, 0.01, 5000.0
PLANTS, ROWS, REPEATS = 200, 10_000, 5
NOISE = np.array([0.002, 0.3])
TRAINING, REFERENCE = 1000, 600


def adaptive_parameters(regressors: Array, outputs: Array, forgetting: float) -> Array:
    """Adaptive parameters after each row, shape (rows, p)."""
    forget = ([1.0], [1.0, -forgetting])
    information = signal.lfilter(*forget, regressors[:, :, None] * regressors[:, None, :], axis=0)
    information += 1e-6 * np.eye(regressors.shape[1])
    right = signal.lfilter(*forget, regressors * outputs[:, None], axis=0)
    return np.asarray(np.linalg.solve(information, right[:, :, None])[:, :, 0], dtype=np.float64)


def newey_west(scores: Array, lags: int) -> Array:
    """Long-run covariance of scores with the weights of Bartlett."""
    total = scores.T @ scores
    for lag in range(1, lags):
        at_lag = scores[lag:].T @ scores[:-lag]
        total += (1.0 - lag / lags) * (at_lag + at_lag.T)
    return np.asarray(total / len(scores))


def other(regressors: Array, residuals: Array, *, textbook: bool) -> ParameterT2:
    """The chart with another Omega."""
    rows, p = regressors.shape
    h = regressors.T @ regressors / rows
    e = residuals - regressors @ np.linalg.solve(h, regressors.T @ residuals / rows)
    e *= sqrt(rows / (rows - p))
    lags = int(1.3 * sqrt(rows))
    omega = h * float(np.mean(e * e)) if textbook else newey_west(regressors * e[:, None], lags)
    share = (1.0 + FORGETTING**rows) / (1.0 - FORGETTING**rows)
    root = np.linalg.inv(np.linalg.cholesky(omega)) @ h / sqrt(WEIGHT / (2.0 - WEIGHT) * (1.0 + share))
    return ParameterT2(NAMES, root, parameter_limit(ARL0, p, WEIGHT, rows if textbook else 1.5 * rows / lags, share))


def alarms(chart: ParameterT2, differences: Array) -> float:
    """Number of alarms; a further one counts only after the statistic has been back at its centre."""
    points = [chart.update(d) for d in differences]
    events = [1 if point.out else -1 for point in points if point.out or point.statistic <= point.centre]
    return float(np.sum(np.diff(events, prepend=-1) == 2))


def false_alarms(training: int, correlation: float) -> list[tuple[float, float]]:
    """Number of false alarms over the promised one, and its standard error, of the three charts."""
    counts = []
    for seed in range(PLANTS):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal(training + ROWS + 101)
        white = 0.1 * sqrt(1.0 - correlation**2) * rng.standard_normal(u.size)
        v = signal.lfilter([1.0], [1.0, -correlation], white)
        y = signal.lfilter([1.0], [1.0, -0.8], 0.5 * np.concatenate([[0.0], u[:-1]]) + v)
        regressors = np.column_stack([y[:-1], u[:-1], np.ones(u.size - 1)])[100:]
        parameters = adaptive_parameters(regressors, y[101:], FORGETTING)
        reference = parameters[training - 1]
        seen = regressors[:training]
        residuals = y[101 : 101 + training] - seen @ reference
        charts = [
            parameter_drift.learn(seen, residuals, FORGETTING, training, ARL0, NAMES, past_outputs=1),
            other(seen, residuals, textbook=False),
            other(seen, residuals, textbook=True),
        ]
        counts.append([alarms(chart, parameters[training:] - reference) for chart in charts])
    ratios = np.array(counts) * ARL0 / ROWS
    return list(zip(ratios.mean(axis=0), ratios.std(axis=0) / sqrt(PLANTS), strict=True))


def reactor(u: Array, rng: np.random.Generator) -> Array:
    """Outputs C and T of the reactor, with noise."""
    run = Simulator(cstr()).run(np.arange(u.size) / 10, u, np.array([0.1, 438.54]))
    return run.outputs + NOISE * rng.standard_normal(run.outputs.shape)


def in_service(name: str, later: Array, rng: np.random.Generator) -> None:
    """Print the largest T2 over its limit, with the excitation that is left counted and not."""
    u = np.concatenate([np.repeat(rng.uniform(90, 108, TRAINING // 10), 10), later])
    for label, y in zip("CT", reactor(u, rng).T, strict=True):
        scaled_u, scaled_y = ((x - x[:50].mean()) / x[:50].std() for x in (u, y))
        lags = [scaled_y[3 - i : -i] for i in (1, 2, 3)] + [scaled_u[3 - i : -i] for i in (1, 2, 3)]
        regressors = np.column_stack([*lags, np.ones(u.size - 3)])
        parameters = adaptive_parameters(regressors, scaled_y[3:], 0.999)
        differences = parameters - parameters[REFERENCE - 1]
        residuals = scaled_y[3 : 3 + TRAINING] - regressors[:TRAINING] @ parameters[REFERENCE - 1]
        names = ["a1", "a2", "a3", "b1", "b2", "b3", "c"]
        chart = parameter_drift.learn(regressors[:TRAINING], residuals, 0.999, REFERENCE, 1e6, names, past_outputs=3)
        pairs = list(zip(differences[TRAINING:], regressors[TRAINING:], strict=True))
        without = max(chart.update(d).statistic for d, _ in pairs) / chart.limit
        with_it = max(chart.update(d, row).statistic for d, row in pairs) / chart.limit
        print(f"{name:<24}{label}{without:12.1f}{with_it:12.2f}")


def cost() -> None:
    """Print the cost of a row, of the seven parameters of order 3."""
    rng = np.random.default_rng(1)
    names = [str(number) for number in range(7)]
    chart = parameter_drift.learn(rng.standard_normal((1000, 7)), rng.standard_normal(1000), 0.999, 1000, 1e6, names, 3)
    rows = list(rng.standard_normal((20_000, 7)))
    best = np.inf
    for _ in range(REPEATS):
        start = time.perf_counter()
        for row in rows:
            chart.update(row, row)
        best = min(best, (time.perf_counter() - start) / len(rows))
    print(f"cost a row {best * 1e6:.2f} us (goal: 3)\n")


def main() -> None:
    """Measure and print."""
    cost()
    print(f"{'false alarms':<14}{'AR(1)':>6}{'cosines':>16}{'Newey & West':>16}{'textbook':>16}")
    for training in (500, 2000):
        for correlation in (0.0, 0.5, 0.9):
            told = "".join(f"{ratio:9.2f} ± {error:4.2f}" for ratio, error in false_alarms(training, correlation))
            print(f"{training:>5} rows    {correlation:>6}{told}")
    rng = np.random.default_rng(1)
    print(f"\n{'T2 / limit, at most':<24}{'':<1}{'without g':>12}{'with g':>12}")
    in_service("steps every minute", np.repeat(rng.uniform(90, 108, 600), 10), rng)
    in_service("at rest", np.full(6000, 100.0), rng)
    in_service("steps every half hour", np.repeat(rng.uniform(90, 108, 20), 300), rng)
    in_service("steps of a ninth", np.repeat(rng.uniform(99, 101, 600), 10), rng)


if __name__ == "__main__":
    main()
