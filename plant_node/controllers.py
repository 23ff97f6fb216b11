"""Controllers of the plant: of the temperature, by the coolant flow; of the level, by the outflow.

Temperature. A proportional controller, as in the study that this project starts from:

    qc = qc0 + Kp (T_measured - T_set)

It acts once a row, on the temperature measured in that row, noise included, and its command is held until the next row.
More coolant makes the reactor colder, so a positive Kp is negative feedback. There is no integral action: the steady
offset of the temperature from its set point is (qc - qc0) / Kp.

The range of Kp follows from the linear plant sampled with period h, x(k+1) = Phi x(k) + Gamma qc(k): the loop is stable
while the eigenvalues of Phi + Kp Gamma c (c picks T) lie inside the unit circle: Astrom & Wittenmark (1997),
Computer-Controlled Systems, ch. 3. With rows of 0.1 min, at the operating points between 85 and 111 l/min, that is
below 18 l/min/K (the limit of the hottest point, 85 l/min); with rows 0.2 and 0.3 min apart below 7.7 and 2.0. The
default of 4 keeps a gain margin above 4, damps the point at 111 l/min (from a radius of 0.989 to 0.882), and passes a
thermometer's noise of 0.3 K on as 1.2 l/min. It also stabilises flows beyond 112 l/min, where the plant in open loop is
unstable.

Level. See `reactorwatch.process.level_control`.
"""

from itertools import pairwise
from math import isfinite
from typing import TypeAlias

import casadi as ca
import msgspec

from plant_node.actuators import CoolantValve
from plant_node.scenario import SIGNAL
from reactorwatch.errors import InputError
from reactorwatch.process import level_control
from reactorwatch.process.library.cstr.model import OPERATING_COOLANT_FLOW, OPERATING_STATE
from reactorwatch.process.model import ProcessModel

CONTROLLED = "T"
GAIN = 4.0
"""Default gain of the temperature controller, l/min/K."""

SetPoint: TypeAlias = float | tuple[tuple[float, float], ...]

_EDGE_MIN = 1e-9  # rounding of a row's time relative to a step


class TemperatureControl(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A proportional controller of the temperature, without a state.

    Attributes:
        set_point_K: one value, or steps as pairs of plant time in min and K, the first at 0, like
            [[0, 438.54], [60, 440]].
        gain_l_min_K: Kp.
        base_flow_l_min: qc0, the coolant flow at the set point.
        dither: whether the scenario's deviation from its mean is added to the command. Identification in closed loop
            needs it: feedback alone is a function of the output and carries no information about the plant.
    """

    set_point_K: SetPoint = OPERATING_STATE[1]  # noqa: N815 # K is the unit
    gain_l_min_K: float = GAIN  # noqa: N815 # as above
    base_flow_l_min: float = OPERATING_COOLANT_FLOW
    dither: bool = False

    def __post_init__(self) -> None:
        if not (isfinite(self.gain_l_min_K) and self.gain_l_min_K > 0):
            raise ValueError(f"gain_l_min_K must be above 0, got {self.gain_l_min_K:g}; for none leave the table out")
        if not (isfinite(self.base_flow_l_min) and self.base_flow_l_min >= 0):
            raise ValueError(f"base_flow_l_min must be at least 0, got {self.base_flow_l_min:g}")
        times = [time for time, _ in self.steps]
        if not times or times[0] != 0 or any(not one < other for one, other in pairwise(times)):
            given = ", ".join(f"{time:g}" for time in times) or "none"
            raise ValueError(f"set_point_K must have steps at rising times in min, the first at 0, got {given}")
        for _, value in self.steps:
            if not (isfinite(value) and value > 0):
                raise ValueError(f"set_point_K must be above 0 K, got {value:g}")

    @property
    def steps(self) -> tuple[tuple[float, float], ...]:
        """The set point as pairs of plant time in min and K."""
        return self.set_point_K if isinstance(self.set_point_K, tuple) else ((0.0, self.set_point_K),)

    def set_point(self, time_min: float) -> float:
        """The set point in K at a plant time of at least 0."""
        return [value for time, value in self.steps if time <= time_min + _EDGE_MIN][-1]

    def command(self, temperature_K: float, time_min: float, dither_l_min: float = 0.0) -> float:
        """Commanded coolant flow in l/min, which may be beyond the valve's range.

        Args:
            temperature_K: temperature measured in the row.
            time_min: time of the row.
            dither_l_min: dither added to the command.
        """
        error_K = temperature_K - self.set_point(time_min)
        return self.base_flow_l_min + dither_l_min + self.gain_l_min_K * error_K

    def check(self, model: ProcessModel, valve: CoolantValve) -> None:
        """Check the settings against a model and a valve.

        Raises:
            InputError: the model has no temperature output, or a set point or the base flow is out of range.
        """
        if CONTROLLED not in model.output_names:
            raise InputError(
                f"temperature_control needs a model with the output {CONTROLLED!r}, "
                f"{model.name} has {model.output_names}"
            )
        if not valve.reaches(self.base_flow_l_min):
            raise InputError(
                f"temperature_control: base_flow_l_min must be in [{valve.lower_l_min:g}, {valve.upper_l_min:g}] "
                f"l/min, got {self.base_flow_l_min:g}"
            )
        for _, value in self.steps:
            check_set_point(model, value)

    def closed_loop(self, model: ProcessModel, valve: CoolantValve) -> ProcessModel:
        """Model of the closed loop in continuous time, at the set point of plant time 0.

        It has the steady state of the sampled loop, which is its purpose, but other transients. The input is the
        coolant flow at the set point: `base_flow_l_min`, dither included.
        """
        qc = model.inputs[model.input_names.index(SIGNAL)].symbol
        temperature = model.outputs[model.output_names.index(CONTROLLED)].expression
        command = qc + self.gain_l_min_K * (temperature - self.set_point(0.0))
        return model.substitute(qc, ca.fmin(ca.fmax(command, valve.lower_l_min), valve.upper_l_min))


def check_set_point(model: ProcessModel, value: float) -> None:
    """Check a temperature set point.

    Raises:
        InputError: it is out of the bounds of the state.
    """
    state = model.states[model.state_names.index(CONTROLLED)]
    if not state.lower <= value <= state.upper:
        raise InputError(
            f"set point of {CONTROLLED} must be in [{state.lower:g}, {state.upper:g}] {state.unit}, got {value:g}"
        )


class LevelControl(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A proportional controller of the level.

    Attributes:
        gain_per_min: Kc, change of the outflow over that of the volume.
    """

    gain_per_min: float = level_control.GAIN

    def __post_init__(self) -> None:
        if not 0 < self.gain_per_min <= 1000:
            raise ValueError(f"gain_per_min must be in (0, 1000], got {self.gain_per_min:g}")
