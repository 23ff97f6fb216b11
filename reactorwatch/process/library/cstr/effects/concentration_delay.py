"""The analyser shows what was there some time ago."""

import casadi as ca

from reactorwatch.process.effect import SensorEffect
from reactorwatch.process.effect_states import positive
from reactorwatch.process.model import ProcessModel, variable

WINDOW_MIN = 1.0
"""The stretch of the past that is remembered; all of the delay if that is longer."""

COEFFICIENTS = 10
"""Legendre polynomials that the stretch is remembered by."""


class ConcentrationDelay(SensorEffect):
    """The measured concentration is C(t - m).

    No finite number of states holds a stretch of the past exactly. Here it is remembered by its first `COEFFICIENTS`
    Legendre coefficients, the best of all linear memories of this size for a delay (Voelker, Kajic & Eliasmith 2019,
    Legendre memory units, NeurIPS 32, eqs. 1-4): over a window theta,

        theta dq_i/dt = (2i + 1) (sum_j a_ij q_j + (-1)^i C),    a_ij = -1 where i < j, else (-1)^(i-j+1),
        C(t - m) = sum_i P_i(2 m/theta - 1) q_i,

    and of this sum what it is off by at m = 0 is taken away. The window does not depend on m up to `WINDOW_MIN`, so the
    delay may set in, grow and go, and the polynomials have a derivative by m at zero.

    With the coolant stepping every minute over its whole range, what is shown is off by 0.0001 mol/l (root mean square)
    up to m = 1 min, 0.001 at 2 min, 0.003 at 3 min.
    """

    name = "concentration_delay"
    label = "delay of the analyser"
    location = "concentration_sensor"
    unit = "min"
    larger = "analyser shows what was there {} min before"
    lower = 0.0
    upper = 3.0
    typical = 0.2
    starts = (0.1, 0.5, 1.5)
    output = late_output = "C"

    def sensed(self, model: ProcessModel, value: ca.SX, size: ca.SX) -> tuple[ProcessModel, ca.SX]:
        """See `SensorEffect`."""
        prefix = self.prefix(model)
        states = [
            variable(f"{prefix}.window_{i}", "mol/l", (-10.0, 10.0), 0.1, f"Legendre coefficient {i} of the past")
            for i in range(COEFFICIENTS)
        ]
        q = [state.symbol for state in states]
        delay = positive(size)
        window = ca.fmax(delay, WINDOW_MIN)
        # The sum over j of a_ij q_j: all after i, and the alternating sum up to i, each carried along.
        after, alternating = sum(q, ca.SX(0)), ca.SX(0)
        for i, state in enumerate(states):
            after, alternating = after - q[i], q[i] - alternating
            sign = (-1) ** i
            rate = (2 * i + 1) / window * (sign * value - after - alternating)
            model = model.with_state(state, rate, at_rest=value if i == 0 else ca.SX(0))
        x = 2 * delay / window - 1
        before, polynomial, shown = ca.SX(0), ca.SX(1), value
        for i in range(COEFFICIENTS):
            shown = shown + (polynomial - (-1) ** i) * q[i]
            before, polynomial = polynomial, ((2 * i + 1) * x * polynomial - i * before) / (i + 1)
        return model, shown
