"""Controllers of the reactor: of the temperature, by the coolant flow; of the level, by the outflow.

Temperature. A proportional controller, as in the study that this project starts from:

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

Level. See `level_control`.
"""

from math import isfinite

import msgspec

from reactorwatch.process.controller import Controller, SetPoint, check_steps, steps_of
from reactorwatch.process.library.cstr import level_control
from reactorwatch.process.library.cstr.model import OPERATING_COOLANT_FLOW, OPERATING_STATE
from reactorwatch.process.model import ProcessModel

GAIN = 4.0
"""Default gain of the temperature controller, l/min/K."""


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
    gain_l_min_K: float = GAIN  # noqa: N815 # as above
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
        gain_per_min: Kc, change of the outflow over that of the volume.
    """

    gain_per_min: float = level_control.GAIN

    def __post_init__(self) -> None:
        if not 0 < self.gain_per_min <= 1000:
            raise ValueError(f"gain_per_min must be in (0, 1000], got {self.gain_per_min:g}")

    def extend(self, model: ProcessModel) -> ProcessModel:
        """See `ContinuousController`."""
        return level_control.with_level_control(model, self.gain_per_min)
