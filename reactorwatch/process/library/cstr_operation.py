"""Operation of the reactor: its controllers, named runs and sample records.

**Runs.** The default levels keep the nominal plant on its operating branch; a large or fast enough change of the
coolant flow extinguishes it.

Of the named runs one is fault-free and three have a fault. They differ in their fault only: same input, same noise,
same length, and with the same seed the same rows until the fault sets in, two hours of monitoring after the hundred
minutes of training. The flow goes up to 105 l/min instead of 111, where the slower reaction would extinguish.

Input leakage: the input is the coolant flow, so coolant leaks between the valve and the jacket while `qc` remains the
command. Of internal parameters, the two that change in a real plant: heat transfer, as the jacket fouls, and the
reaction rate, as a catalyst deactivates. They differ in kind, too. Less heat transfer warms the reactor as the leakage
does, and differs from it only in its dependence on the flow; a slower reaction cools it. (The activation energy would
be a second name for the rate: near one temperature a change of E/R is one of k0.)

The sizes move the operating point by several standard deviations of the thermometer, and keep the plant on its
operating branch.

**Control of the temperature**, by the coolant flow. A proportional controller, as in the study that this project starts
from:

    qc = qc0 + Kp (T_measured - T_set)

More coolant makes the reactor colder, so a positive Kp is negative feedback. There is no integral action: the steady
offset of the temperature from its set point is (qc - qc0) / Kp.

The range of Kp follows from the linear plant sampled with period h, x(k+1) = Phi x(k) + Gamma qc(k): the loop is stable
while the eigenvalues of Phi + Kp Gamma c (c picks T) lie inside the unit circle: Astrom & Wittenmark (1997),
Computer-Controlled Systems, ch. 3. With rows of 0.1 min, at the operating points between 85 and 111 l/min, that is
below 18 l/min/K (the limit of the hottest point, 85 l/min); with rows 0.2 and 0.3 min apart below 7.7 and 2.0. The
default of 4 keeps a gain margin above 4, damps the point at 111 l/min (from a radius of 0.989 to 0.882), and passes a
thermometer's noise of 0.3 K on as 1.2 l/min. It also stabilises flows beyond 112 l/min, where the plant in open loop is
unstable.

**Control of the level**, by the outflow: the volume is a state, held by a controller that moves the outflow.

    dV/dt = q - q_out          q_out = max(0, q0 + Kc (V - V_set))

The balances of mass and energy keep their form, because what leaves has the composition and the temperature of the
contents: from d(V C)/dt = q Cf - q_out C - V r follows dC/dt = q/V (Cf - C) - r. What changes is that V is now what the
level is, and that K2, which holds 1/V as a factor, changes with it.

A proportional controller leaves an offset: with a steady inflow q the level rests at V_set + (q - q0) / Kc. The faster
it is, the closer the plant comes to the one of constant volume, which is its limit for Kc -> infinity.
"""

from dataclasses import replace
from math import isfinite

import casadi as ca
import msgspec

from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr import OPERATING_COOLANT_FLOW, OPERATING_STATE
from reactorwatch.process.model import ProcessModel, parameter, variable
from reactorwatch.process.operation import (
    Controller,
    Example,
    InputLevels,
    Operation,
    Preset,
    SetPoint,
    WatchDefaults,
    check_steps,
    steps_of,
)


class TemperatureControl(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A proportional controller of the temperature.

    Attributes:
        set_point_K: one value, or steps as pairs of plant time in min and K, the first at 0, like
            [[0, 438.54], [60, 440]].
        gain_l_min_K: Kp.
        base_flow_l_min: qc0, the coolant flow at the set point.
        dither: see `Controller`.
    """

    set_point_K: SetPoint = OPERATING_STATE[1]  # noqa: N815 # K is the unit
    gain_l_min_K: float = 4.0  # noqa: N815 # as above
    base_flow_l_min: float = OPERATING_COOLANT_FLOW
    dither: bool = False

    def __post_init__(self) -> None:
        if not (isfinite(self.gain_l_min_K) and self.gain_l_min_K > 0):
            raise ValueError(f"gain_l_min_K must be above 0, got {self.gain_l_min_K:g}; for none leave the table out")
        if not (isfinite(self.base_flow_l_min) and self.base_flow_l_min >= 0):
            raise ValueError(f"base_flow_l_min must be at least 0, got {self.base_flow_l_min:g}")
        for _, value in steps_of(self.set_point_K):
            if not (isfinite(value) and value > 0):
                raise ValueError(f"set_point_K must be above 0 K, got {value:g}")
        check_steps("set_point_K", self.set_point_K)

    def controller(self) -> Controller:
        """The controller in general terms."""
        return Controller("qc", "T", self.set_point_K, self.gain_l_min_K, self.base_flow_l_min, dither=self.dither)


class LevelControl(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A proportional controller of the level.

    Attributes:
        gain_per_min: Kc, change of the outflow over that of the volume; the default has a time constant of 12 seconds.
    """

    gain_per_min: float = 5.0

    def __post_init__(self) -> None:
        if not 0 < self.gain_per_min <= 1000:
            raise ValueError(f"gain_per_min must be in (0, 1000], got {self.gain_per_min:g}")

    def extend(self, model: ProcessModel) -> ProcessModel:
        """Make the volume of a model a state.

        Args:
            model: with the parameters `V` and `q`, and `K2` in proportion to 1/V.

        Returns:
            A model with the further state `V` (l), and in place of the parameter `V` the parameters `V_set` (what `V`
            was), `level_gain` and `q0` (the outflow at the set point: what `q` is now).

        Raises:
            ValueError: the model lacks one of these parameters.
        """
        volume, inflow, cooling = (model.parameter(name) for name in ("V", "q", "K2"))
        V = variable("V", "l", (1e-3 * volume.value, 10 * volume.value), 0.1 * volume.value, "volume of the contents")
        V_set = parameter("V_set", volume.value, "l", (volume.lower, volume.upper), "set point of the level controller")
        level_gain = parameter("level_gain", self.gain_per_min, "1/min", (0.0, 1e4), "of the level controller")
        q0 = parameter("q0", inflow.value, inflow.unit, (0.0, inflow.upper), "outflow at the set point of the level")
        changed = model.substitute(cooling.symbol, cooling.symbol * V_set.symbol / V.symbol)
        changed = changed.substitute(volume.symbol, V.symbol)
        outflow = ca.fmax(q0.symbol + level_gain.symbol * (V.symbol - V_set.symbol), 0)
        return replace(
            changed,
            states=(*model.states, V),
            parameters=(*(item for item in model.parameters if item.name != "V"), V_set, level_gain, q0),
            rhs=(*changed.rhs, inflow.symbol - outflow),
        )


BOILING_FROM_K = 440.0
BOILING_RATE = 0.6
"""1/min; both as in the law of the sample record `unknown`."""


class Boiling(Effect):
    """-m max(T - 440 K, 0) in the energy balance: heat of evaporation. It is in no catalogue of causes."""

    name = "boiling"
    label = "boiling of the contents"
    location = "energy_balance"
    unit = "1/min"
    lower = 0.0
    upper = 10.0
    typical = 0.1

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        return model.add_rate("T", -size * ca.fmax(model.state("T") - BOILING_FROM_K, 0))


def _boil(model: ProcessModel) -> ProcessModel:
    return Boiling().extend(model).with_values({"boiling.size": BOILING_RATE})


EXAMPLES = {
    "sound": Example("nothing is wrong"),
    "leak": Example("15 % of the coolant is lost from minute 150 on", ("coolant_flow:step:-0.15@150min",)),
    "fouling": Example(
        "heat transfer falls by 30 % from minute 120 on", ("heat_transfer:ramp:-0.3@120min,end=239.9min",)
    ),
    "analyser_drift": Example(
        "the concentration reading drifts by 0.01 mol/l from minute 120 on",
        ("concentration_bias:ramp:0.01@120min,end=239.9min",),
    ),
    "two_causes": Example(
        "10 % of the coolant is lost, later the thermometer reads 1.5 K too high",
        ("coolant_flow:step:-0.1@130min", "temperature_bias:step:1.5@180min"),
    ),
    "unknown": Example(
        "the contents boil above 440 K all the time, which is no cause of the catalogue",
        law=f"energy balance: -{BOILING_RATE:g} 1/min max(T - {BOILING_FROM_K:g} K, 0)",
        with_law=_boil,
    ),
}
"""The sample records, by name: four hours at the plant's period of 0.1 min."""

ONSET_MIN = 220.0  # of the faults of named runs: two hours after the training
NOISE_SD = {"C": 0.002, "T": 0.3, "qc": 0.0}


def _preset(name: str, meaning: str, *faults: str) -> Preset:
    settings = {
        "duration_min": 400.0,
        "scenario": {"kind": "random-steps", "low": 85.0, "high": 105.0, "hold_min": 1.0},
        "noise_sd": NOISE_SD,
        "faults": [f"{fault}@{ONSET_MIN:g}min" for fault in faults],
    }
    return Preset(name, meaning, settings)


OPERATION = Operation(
    inputs={"qc": InputLevels(level=100.0, low=90.0, high=111.0, swing=5.0)},
    noise_sd=NOISE_SD,
    fault="coolant_flow:step:-0.15",
    presets=(
        _preset("fault-free", "nothing is wrong"),
        _preset("input-leakage", "a tenth of the coolant leaks out", "coolant_flow:step:-0.1"),
        _preset("heat-transfer", "half of the heat transfer is gone", "heat_transfer:step:-0.5"),
        _preset("reaction-rate", "the reaction is a tenth slower", "reaction_rate:step:-0.1"),
    ),
    examples=EXAMPLES,
    watch=WatchDefaults(
        training_min=100.0,
        smallest_sd={"C": 2e-4, "T": 0.05},
        priorities={"T": "high"},
        identified=("T",),
    ),
)
