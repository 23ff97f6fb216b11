"""The three tanks and their effects, held to the published equations written by hand and solved by scipy."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.result import AMBIGUOUS, NAMED, NOMINAL
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.three_tanks import EFFECTS as THREE_TANKS_EFFECTS
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.profiles import CONSTANT
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record

LEVELS_CM = np.array([41.00, 32.00, 36.60])
FLOWS_CM3_S = np.array([21.37, 53.80])
"""Published means of a fault-free record."""

NOISE_CM = 0.1
SIZES = {
    "pump1": 1.0, "pump2": -2.0, "h1.bias": 1.5, "h2.bias": -1.0, "h3.bias": 0.7, "leak1": 0.1, "leak2": 0.2,
    "leak3": 0.1, "clog13": 0.15, "clog20": 0.1, "clog32": 0.2,
}  # fmt: skip


def rates(x: Array, flows: Array, name: str = "", size: float = 0.0) -> list[float]:
    """Rates of the levels in cm/s with one effect, as published."""
    of = {name: size}
    q1, q2 = flows[0] + of.get("pump1", 0.0), flows[1] + of.get("pump2", 0.0)

    def flow(coefficient: float, head: float) -> float:
        return float(coefficient * 0.5 * np.sign(head) * np.sqrt(2 * 981.0 * abs(head)))

    q13 = flow(0.46 * (1 - of.get("clog13", 0.0)), x[0] - x[2])
    q32 = flow(0.45 * (1 - of.get("clog32", 0.0)), x[2] - x[1])
    q20 = flow(0.60 * (1 - of.get("clog20", 0.0)), x[1])
    leaks = [flow(of.get(f"leak{i}", 0.0), level) for i, level in enumerate(x, start=1)]
    return [(q1 - q13 - leaks[0]) / 154, (q2 + q32 - q20 - leaks[1]) / 154, (q13 - q32 - leaks[2]) / 154]


def solve(times_s: Array, flows: Array, name: str = "", size: Callable[[float], float] = lambda _: 0.0) -> Array:
    """Levels at the times, shape (rows, 3), with inputs held between them; sensors' biases included."""
    states = [LEVELS_CM]
    for begin, end, u in zip(times_s[:-1], times_s[1:], flows, strict=False):
        m = size((begin + end) / 2)

        def at(_: float, x: Array, u: Array = u, m: float = m) -> list[float]:
            return rates(x, u, name, m)

        solution = solve_ivp(at, (begin, end), states[-1], rtol=1e-9)
        states.append(solution.y[:, -1])
    levels = np.array(states)
    if name.endswith(".bias"):
        levels[:, int(name[1]) - 1] += [size(t) for t in times_s]
    return levels


def test_the_published_means_are_a_steady_state() -> None:
    """The published coefficients have two digits, so the balances close to 1 % of the flow."""
    model = three_tanks()
    at_rest = Simulator(model).run(np.array([0.0, 1 / 60]), np.tile(FLOWS_CM3_S, (2, 1)), LEVELS_CM).outputs
    assert np.abs(np.diff(at_rest, axis=0) * 154).max() < 0.01 * FLOWS_CM3_S.min()


@pytest.mark.parametrize("effect", THREE_TANKS_EFFECTS, ids=lambda effect: effect.name)
def test_an_effect_on_the_levels_matches_the_equations_by_hand(effect: Effect) -> None:
    times_s = np.arange(0.0, 300.0, 10.0)
    flows = np.repeat(np.random.default_rng(1).uniform([15, 45], [30, 60], (6, 2)), 5, axis=0)
    size = SIZES[effect.name]
    model = effect.extend(three_tanks(), CONSTANT).with_values({f"{effect.name}.size": size})
    found = Simulator(model).run(times_s / 60, flows, LEVELS_CM).outputs
    expected = solve(times_s, flows, effect.name, lambda _: size)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert np.abs(expected - solve(times_s, flows)).max() > 0.1


def measure(name: str, size: float, seed: int = 1) -> Record:
    """Record of 1,200 s in which an effect grows from zero at 300 s, with noise and moving pumps."""
    rng = np.random.default_rng(seed)
    times_s = np.arange(0.0, 1200.0, 4.0)
    flows = FLOWS_CM3_S + np.repeat(rng.uniform(-8, 8, (times_s.size // 30, 2)), 30, axis=0)
    levels = solve(times_s, flows, name, lambda t: size * max(0.0, t - 300.0) / 900.0)
    levels += rng.normal(0.0, NOISE_CM, levels.shape)
    signals = {"Q1": flows[:, 0], "Q2": flows[:, 1], "h1": levels[:, 0], "h2": levels[:, 1], "h3": levels[:, 2]}
    return Record(times_s / 60, signals, "tanks")


def test_a_sound_rig_is_nominal() -> None:
    assert diagnose(measure("", 0.0), three_tanks()).verdict == NOMINAL


@pytest.mark.parametrize(
    ("name", "size", "twins"),
    [
        ("h1.bias", -3.0, set()),
        ("clog13", 0.3, set()),
        ("pump2", 4.0, {"clog20"}),
        ("leak3", 0.05, {"clog32", "clog13"}),
    ],
)
def test_a_growing_fault_is_named_with_two_inputs_and_three_outputs(name: str, size: float, twins: set[str]) -> None:
    found = diagnose(measure(name, size), three_tanks())
    listed = {found.causes[0].cause, *(cause.cause for item in found.alternatives for cause in item.explanation)}
    assert found.verdict == NAMED if not twins else found.verdict in (NAMED, AMBIGUOUS)
    assert name in listed <= {name, *twins}
    (cause,) = found.causes
    if cause.cause == name:
        assert cause.parameters["size"].value == pytest.approx(size, rel=0.2)
