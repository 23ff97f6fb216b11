"""A process that no catalogue has: two heated tanks in a row, the heater's temperature not measured; files and records.

The records are made by an integration of their own, not by the product's.
"""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from reactorwatch.description.read import find_process
from reactorwatch.process.extended_model import stored_model
from reactorwatch.records.record import Record

OWN = {"g": "heating", "h": "fouling", "Tin": "feed", "q": "pump", "k": "loss", "T2": "sensor"}
"""The process's own causes, by what they act on."""
GENERIC = {"g": "g.deviation", "h": "h.deviation", "Tin": "Tin.deviation", "q": "q.gain", "k": "k.deviation"} | {
    "T2": "T2.bias"
}
FORMS = {"own.py": OWN, "plain.py": GENERIC, "described.toml": GENERIC, "extended.json": GENERIC}
"""Files of the process, each with the names of its causes."""

EQUATIONS = """
import reactorwatch as rw


def process():
    W, T1, T2 = (
        rw.variable(name, "degC", (0.0, 300.0), 5.0, meaning, balance=balance)
        for name, meaning, balance in (("W", "heater", "heater"), ("T1", "tank 1", "tank1"), ("T2", "tank 2", "tank2"))
    )
    q = rw.variable("q", "l/min", (1.0, 12.0), 1.0, "feed")
    P = rw.variable("P", "kW", (0.0, 20.0), 3.0, "heating")
    g = rw.parameter("g", 0.72, "K/min/kW", (0.1, 2.0), "heating of tank 1 by 1 kW")
    h = rw.parameter("h", 0.5, "1/min", (0.05, 5.0), "heat transfer of the heater")
    Tin = rw.parameter("Tin", 18.0, "degC", (0.0, 60.0), "temperature of the feed")
    k = rw.parameter("k", 0.02, "1/min", (0.0, 1.0), "heat loss of tank 2")
    given = h.symbol * (W.symbol - T1.symbol)
    rates = (
        (g.symbol * P.symbol - given) / 0.15,
        q.symbol / 20.0 * (Tin.symbol - T1.symbol) + given,
        q.symbol / 30.0 * (T1.symbol - T2.symbol) - k.symbol * (T2.symbol - 20.0),
    )
    outputs = tuple(rw.Output(T.name, "degC", T.symbol) for T in (T1, T2))
    model = rw.ProcessModel("cascade", (W, T1, T2), (q, P), (g, h, Tin, k), rates, outputs, rw.new_clock())
    signals = [rw.Signal("q", "l/min", "input"), rw.Signal("P", "kW", "input")]
    signals += [rw.Signal("T1", "degC", "output"), rw.Signal("T2", "degC", "output")]
    return rw.Process("cascade", tuple(signals), model, effects())


def effects():
"""

OWN_EFFECTS = """
    from reactorwatch.process.effect import ParameterEffect, ParameterShift
    from reactorwatch.process.signal_effects import InputGain, OutputBias

    class Fouling(ParameterEffect):
        \"\"\"Less heat passes from the heater into the tank.\"\"\"

        name, label, location, parameter = "fouling", "fouled heater", "heater", "h"
        larger, smaller, typical = "{} % more heat transfer", "{} % of the heat transfer lost", -0.2

    shares = {"larger": "{} % more", "smaller": "{} % less", "typical": 0.1}
    kelvins = {"unit": "K", "lower": -20.0, "upper": 20.0, "typical": 1.0, "larger": "{} K too much"}
    return (
        ParameterEffect(name="heating", label="other heating", location="heater", parameter="g", **shares),
        Fouling(),
        ParameterShift(name="feed", label="other feed", location="tank1", parameter="Tin", **kelvins),
        InputGain(name="pump", label="other flow", location="tank1", input="q", **shares),
        ParameterEffect(name="loss", label="other heat loss", location="tank2", parameter="k", **shares),
        OutputBias(name="sensor", label="bias of T2", location="T2", output="T2", **kelvins),
    )
"""

DESCRIBED = """
name = "rig"
equations = "extended.json"
[parameters]
k = {value = 0.02, sd = 0.0002, unit = "1/min"}
[[signals]]
name = "q"
role = "input"
unit = "l/min"
[[signals]]
name = "P"
role = "input"
unit = "kW"
[[signals]]
name = "T1"
role = "output"
unit = "degC"
[[signals]]
name = "T2"
role = "output"
unit = "degC"
"""


def write_forms(folder: Path) -> None:
    """Write the process in each of its forms."""
    (folder / "own.py").write_text(EQUATIONS + OWN_EFFECTS)
    (folder / "plain.py").write_text(EQUATIONS + "    return ()\n")
    model = find_process(folder / "plain.py").require_model()
    (folder / "extended.json").write_text(json.dumps(stored_model(model).to_object()))
    (folder / "described.toml").write_text(DESCRIBED)


PERIOD_MIN, STEPS, SETTLING = 0.1, 4, 2000
USUAL = {"g": 0.72, "h": 0.5, "Tin": 18.0, "k": 0.02, "q": 1.0, "T2": 0.0}


def rates(x: np.ndarray, q: float, P: float, now: Mapping[str, float]) -> np.ndarray:
    given = now["h"] * (x[0] - x[1])
    into = now["q"] * q
    return np.array(
        [
            (now["g"] * P - given) / 0.15,
            into / 20.0 * (now["Tin"] - x[1]) + given,
            into / 30.0 * (x[1] - x[2]) - now["k"] * (x[2] - 20.0),
        ]
    )


def simulate(rows: int, seed: int, *changes: tuple[int, str, float], heating: float | None = None) -> Record:
    """Record of the tanks, a row every 6 s, noise of 0.05 K.

    Args:
        rows: number of rows.
        seed: of inputs and noise.
        changes: row from which on something has another value: a parameter, the factor of `q`, the bias of `T2`.
        heating: level of a heating that never moves; None: it moves.
    """
    random, now = np.random.default_rng(seed), dict(USUAL)
    flow = np.repeat(random.uniform(3.0, 8.0, rows // 20 + 1), 20)[:rows]
    power = np.repeat(random.uniform(4.0, 12.0, rows // 30 + 1), 30)[:rows]
    power = power if heating is None else np.full(rows, heating)
    x, measured = np.array([50.0, 35.0, 33.0]), np.empty((rows, 2))
    for row in range(-SETTLING, rows):
        now |= {name: value for at, name, value in changes if at == max(row, 0)}
        inputs, h = (float(flow[max(row, 0)]), float(power[max(row, 0)])), PERIOD_MIN / STEPS
        if row >= 0:
            measured[row] = x[1:] + (0.0, now["T2"]) + 0.05 * random.normal(size=2)
        for _ in range(STEPS):
            a = rates(x, *inputs, now)
            b = rates(x + 0.5 * h * a, *inputs, now)
            c = rates(x + 0.5 * h * b, *inputs, now)
            x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + rates(x + h * c, *inputs, now))
    columns = {"q": flow, "P": power, "T1": measured[:, 0], "T2": measured[:, 1]}
    return Record(PERIOD_MIN * np.arange(rows, dtype=np.float64), columns, "cascade")
