"""Delay of the analyser."""

import casadi as ca

from reactorwatch.process.effect import SensorEffect
from reactorwatch.process.effect_states import nonnegative
from reactorwatch.process.model import ProcessModel, variable

WINDOW_MIN = 1.0
"""Length of the past that the states represent; the delay if that is longer."""

COEFFICIENTS = 10
"""Number of Legendre polynomials."""


class ConcentrationDelay(SensorEffect):
    """The measured concentration is C(t - m).

    No finite number of states represents the past exactly. Here its first `COEFFICIENTS` Legendre coefficients do, the
    best of all linear memories of this size for a delay (Voelker, Kajic & Eliasmith 2019, Legendre memory units,
    NeurIPS 32, eqs. 1-4): over a window theta,

        theta dq_i/dt = (2i + 1) (sum_j a_ij q_j + (-1)^i C),    a_ij = -1 where i < j, else (-1)^(i-j+1),
        C(t - m) = sum_i P_i(2 m/theta - 1) q_i,

    less the sum's error at m = 0. Up to `WINDOW_MIN` the window does not depend on m, so the delay may set in, grow and
    disappear, and the polynomials have a derivative with respect to m at zero.

    With the coolant stepping every minute over its whole range, the error is 0.0001 mol/l (root mean square) up to m =
    1 min, 0.001 at 2 min, 0.003 at 3 min.
    """

    name = "concentration_delay"
    label = "delay of the analyser"
    location = "concentration_sensor"
    unit = "min"
    larger = "analyser shows what was there {} min before"
    lower = 0.0
    upper = 3.0
    typical = 0.2
    start_values = (0.1, 0.5, 1.5)
    output = delays_output = "C"

    def sense(self, model: ProcessModel, value: ca.SX, size: ca.SX) -> tuple[ProcessModel, ca.SX]:
        """See `SensorEffect`."""
        prefix = self.prefix(model)
        states = [
            variable(f"{prefix}.window_{i}", "mol/l", (-10.0, 10.0), 0.1, f"Legendre coefficient {i} of the past")
            for i in range(COEFFICIENTS)
        ]
        q = [state.symbol for state in states]
        delay = nonnegative(size)
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
