"""Plants of others, by their own simulators: pcgym's four tanks, TCLab's simulator, van de Vusse's reactor in do-mpc.

One constant is 2 % off, either way. Inputs step at random and wander about each level; in every other record of a plant
they wander by themselves, too, which the record does not show. Causes are a sensor's bias, an actuator's gain, and a
constant (`foreign.toml`).

do-mpc and tclab are in the dependency group `peers`. pcgym asks for gigabytes, of which the four tanks use a part:
`python -m benchmarks.inexact.foreign` installs it in an environment of its own. Its levels are kept there, too, and are
not computed again.
"""

import contextlib
import hashlib
import importlib.util
import io
import json
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from platformdirs import user_cache_path
from scipy.signal import lfilter

from benchmarks.inexact.records import Array, Cause, Drawn, draw_moves, level_at
from reactorwatch.errors import InputError

FOLDER = Path(__file__).parent
PLANTS = tomllib.loads((FOLDER / "foreign.toml").read_text(encoding="utf-8"))
ROWS, SETTLING_ROWS, LONGEST_HOLD_ROWS = 1200, 400, 240
STEP_OFF, WANDER, WANDER_UNSEEN, WANDER_ROWS = 0.02, 0.03, 0.015, 20.0
"""Error of a constant, standard deviations of the inputs as shares of their ranges, and their time constant."""

PCGYM = user_cache_path("reactorwatch") / "pcgym"
PACKAGES = ("casadi", "cloudpickle", "diffrax", "do-mpc", "gymnasium", "jax[cpu]", "matplotlib", "tqdm")
"""Packages that pcgym imports; it asks for torch, onnx and ruff as well, which the four tanks do not use."""

Stretch = tuple[Mapping[str, float], Array]
"""Constants of the plant, and its inputs by row."""


def simulate_tanks(stretches: Sequence[Stretch], noise: Array) -> Array:
    """Levels by pcgym."""
    named = [
        {
            "constants": {name.replace("gamma", "gamma_"): value for name, value in constants.items()},
            "inputs": part.tolist(),
        }
        for constants, part in stretches
    ]
    job = json.dumps({"start": [0.2] * 4, "period_s": PLANTS["four_tanks"]["period_s"], "stretches": named})
    file = PCGYM / f"{hashlib.sha256(job.encode()).hexdigest()[:16]}.json"
    if not file.exists():
        command = [PCGYM / "bin" / "python", FOLDER / "pcgym_run.py"]
        done = subprocess.run(command, input=job, capture_output=True, text=True, check=True)
        file.write_text(done.stdout.splitlines()[-1], encoding="utf-8")
    return np.asarray(json.loads(file.read_text(encoding="utf-8")) + noise)


def simulate_tclab(stretches: Sequence[Stretch], noise: Array) -> Array:
    """Temperatures by TCLab's simulator in our time; it rounds them down to steps of 0.3223 K."""
    from tclab.tclab import TCLabModel

    with contextlib.redirect_stdout(io.StringIO()):
        lab = TCLabModel(synced=False)
    measured: list[list[float]] = []
    lab.tlast = 0.0
    for constants, inputs in stretches:
        lab._P1, lab._P2, lab.Ta = constants.values()
        for powers in inputs:
            lab.update(PLANTS["tclab_simulator"]["period_s"] * len(measured))
            measured.append(
                [lab.quantize(T + e) for T, e in zip((lab._T1, lab._T2), noise[len(measured)], strict=True)]
            )
            lab._Q1, lab._Q2 = powers
    return np.array(measured)


def simulate_reactor(stretches: Sequence[Stretch], noise: Array) -> Array:
    """Measurements of van de Vusse's reactor by do-mpc, with the equations of its example."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of packages that do-mpc can do without
        import casadi as ca
        import do_mpc
    plant = PLANTS["van_de_vusse"]
    model = do_mpc.model.Model("continuous", "SX")
    Ca, Cb, TR, TK = (model.set_variable("_x", name) for name in ("C_a", "C_b", "T_R", "T_K"))
    F, Q = (model.set_variable("_u", name) for name in plant["inputs"])
    K0_ab, K0_ad, K_w, C_A0 = (model.set_variable("_p", name) for name in plant["constants"])
    k1, k2 = (k0 * ca.exp(-9758.3 / (TR + 273.15)) for k0 in (K0_ab, 1.287e12))
    k3 = K0_ad * ca.exp(-8560.0 / (TR + 273.15))
    heat, wall = k1 * Ca * 4.2 - k2 * Cb * 11.0 - k3 * Ca**2 * 41.85, K_w * 0.215 * (TK - TR)
    model.set_rhs("C_a", F * (C_A0 - Ca) - k1 * Ca - k3 * Ca**2)
    model.set_rhs("C_b", -F * Cb + k1 * Ca - k2 * Cb)
    model.set_rhs("T_R", -heat / (0.9342 * 3.01) + F * (130.0 - TR) + wall / (0.9342 * 3.01 * 10.01))
    model.set_rhs("T_K", (Q - wall) / (5.0 * 2.0))
    model.setup()
    simulator = do_mpc.simulator.Simulator(model)
    simulator.set_param(t_step=plant["period_s"] / 3600.0, abstol=1e-10, reltol=1e-10)
    values = simulator.get_p_template()
    simulator.set_p_fun(lambda _: values)
    simulator.setup()
    x, measured = np.array([[2.0], [1.0], [120.0], [118.0]]), []
    simulator.x0 = x
    for constants, inputs in stretches:
        for name, value in constants.items():
            values[name] = value
        for row in inputs:
            measured.append(x[1:, 0])
            x = simulator.make_step(row.reshape(-1, 1))
    return np.asarray(np.array(measured) + noise)


SIMULATORS = {"four_tanks": simulate_tanks, "tclab_simulator": simulate_tclab, "van_de_vusse": simulate_reactor}
"""Functions of constants and inputs by row, and of what is added to the outputs, that return what is measured."""


PACKAGE_OF = {"tclab_simulator": "tclab", "van_de_vusse": "do_mpc"}


def missing_of(name: str) -> str:
    """Instruction to install what the simulator of a plant needs; empty if it is installed."""
    if name == "four_tanks":
        installed = (PCGYM / "bin" / "python").exists()
        cure = "pcgym is not installed; run `python -m benchmarks.inexact.foreign`, which installs it apart"
    else:
        installed = importlib.util.find_spec(PACKAGE_OF[name]) is not None
        cure = f"{PACKAGE_OF[name]} is not installed; run `pip install --group peers`"
    return "" if installed else f"{name}: {cure}"


class Span(NamedTuple):
    """Length of a record, and its cause."""

    rows: int = ROWS  # rows of the record
    onset_rows: tuple[float, float] = (0.3 * ROWS, 0.7 * ROWS)  # earliest and latest row of the onset
    is_medium: bool = False  # true if causes have the middle of their sizes


USUAL = Span()


def draw(seed: int, number: int, sound: bool, span: Span = USUAL) -> Drawn:
    """Draw a record: the plants take turns, then the causes of each.

    Raises:
        InputError: the plant's simulator is not installed.
    """
    turn, index = divmod(number, len(PLANTS))
    name, plant = list(PLANTS.items())[index]
    if missing := missing_of(name):
        raise InputError(missing)
    rng, rows = np.random.default_rng([seed, 5, int(sound), number]), SETTLING_ROWS + span.rows
    hold = (LONGEST_HOLD_ROWS / 3, LONGEST_HOLD_ROWS)
    moves = [draw_moves(rng, rows, hold, levels, 1.0) for levels in plant["inputs"].values()]
    inputs = np.stack([level_at(item, np.arange(rows, dtype=np.float64)) for item in moves], axis=1)
    spans = np.array([high - low for low, high in plant["inputs"].values()])
    inputs = inputs + WANDER * spans * _wander(rng, inputs.shape)
    is_unseen = turn % 2 == 1
    actual = inputs + (WANDER_UNSEEN * spans * _wander(rng, inputs.shape) if is_unseen else 0.0)
    onset = SETTLING_ROWS + int(rng.uniform(*span.onset_rows))
    causes, constants = plant["causes"], plant["constants"]
    order = np.random.default_rng([seed, 6, index, turn // len(causes)]).permutation(len(causes))
    names, least, most = causes[int(order[turn % len(causes)])]
    if span.is_medium:
        least = most = 0.5 * (least + most)
    size = 0.0 if sound else float(rng.choice((-1.0, 1.0)) * rng.uniform(least, most))
    off = str(rng.choice([item for item in constants if f"{item}.deviation" not in names]))
    factor = float(rng.choice((1.0 - STEP_OFF, 1.0 + STEP_OFF)))
    before = constants | {off: constants[off] * factor}
    noise = np.array(list(plant["noise"].values())) * rng.standard_normal((rows, len(plant["noise"])))
    after, (place, kind) = dict(before), names[0].split(".")
    if kind == "bias":
        noise[onset:, list(plant["noise"]).index(place)] += size
    elif kind == "gain":
        actual[onset:, list(plant["inputs"]).index(place)] *= 1.0 + size
    else:
        after[place] += size if place == "Ta" else size * before[place]
    measured = SIMULATORS[name]([(before, actual[:onset]), (after, actual[onset:])], noise)
    columns = {"time_s": plant["period_s"] * np.arange(span.rows, dtype=np.float64)}
    columns |= dict(zip(plant["inputs"], inputs[SETTLING_ROWS:].T, strict=True))
    columns |= dict(zip(plant["noise"], measured[SETTLING_ROWS:].T, strict=True))
    period_min = plant["period_s"] / 60.0
    unit = "of the output" if kind == "bias" or place == "Ta" else "1"
    cause = None if sound else Cause(tuple(names), (size,), unit, (onset - SETTLING_ROWS) * period_min)
    process = (FOLDER / "processes" / f"{name}.py").read_text(encoding="utf-8")
    inexact = {off: factor - 1.0, "inputs wander unseen": is_unseen}
    group = f"{name}, inputs wander unseen" if is_unseen else name
    return Drawn(name, group, seed, number, process, columns, period_min, cause, inexact)


def _wander(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """First-order Gauss-Markov signals of unit variance."""
    kept = np.exp(-1.0 / WANDER_ROWS)
    return np.asarray(lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], rng.standard_normal(shape), axis=0))


if __name__ == "__main__":
    pip = [str(PCGYM / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    for command in ([sys.executable, "-m", "venv", str(PCGYM)], [*pip, "--no-deps", "pcgym"], [*pip, *PACKAGES]):
        subprocess.run(command, check=True)
