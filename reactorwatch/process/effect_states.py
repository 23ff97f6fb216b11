"""States that effects add to a model: initial values, jumps, the first-order lag and the delay.

A lag z of a quantity y with time constant m, dz/dt = (y - z)/m, is arbitrarily stiff for m -> 0. So below `QUICK_MIN`
the state's time constant M is larger than m, and the output takes only a share of it,

    dz/dt = (y - z) / M(m),    output = y + m/M(m) (z - y),

where M is m itself from `QUICK_MIN` on and half of that at m = 0, with two continuous derivatives between. The output
lags behind a ramp by m for any m; at m = 0 it is y itself, to the last bit, and approaches it as smoothly as the true
lag. While m is 0 the state is reset to y at every row, so a lag that sets in starts at y, except for y's change since
the row began.

For a delay no finite number of states represents the past exactly. Here its first `COEFFICIENTS` Legendre coefficients
do, the best of all linear memories of this size (Voelker, Kajic & Eliasmith 2019, Legendre memory units, NeurIPS 32,
eqs. 1-4): over a window theta,

    theta dq_i/dt = (2i + 1) (sum_j a_ij q_j + (-1)^i y),    a_ij = -1 where i < j, else (-1)^(i-j+1),
    y(t - m) = sum_i P_i(2 m/theta - 1) q_i,

less the sum's error at m = 0. Up to `WINDOW_MIN` the window does not depend on m, so the delay may set in, grow and
disappear, and the polynomials have a derivative with respect to m at zero.
"""

import casadi as ca

from reactorwatch.process.model import ProcessModel, Variable, variable

QUICK_MIN = 0.07
"""Half of this is 0.7 of the longest step of the integrator, so a lag is never stiff: a step's error is 0.001 of the
followed value. With 0.1 min a lag of 0.03 min erred by a tenth of the sensors' noise, which 7,500 rows reveal."""

WINDOW_MIN = 1.0
"""Length of the past that the states of a delay represent; the delay if that is longer."""

COEFFICIENTS = 10
"""Number of Legendre polynomials of a delay."""


def nonnegative(size: ca.SX) -> ca.SX:
    """max(size, 0), with a derivative of 1 at zero, where a fit starts."""
    return ca.if_else(size >= 0, size, 0)


def add_lag(
    model: ProcessModel, state: Variable, followed: ca.SX, time_constant_min: ca.SX
) -> tuple[ProcessModel, ca.SX]:
    """Add a first-order lag to a model; returns the model and the lag's output.

    Args:
        model: the model that the state is added to.
        state: the lagging state.
        followed: the quantity that it follows.
        time_constant_min: any expression; negative values count as 0.
    """
    m = nonnegative(time_constant_min)
    x = ca.fmin(m / QUICK_MIN, 1)
    lag = ca.if_else(m < QUICK_MIN, QUICK_MIN * (0.5 + x**3 - 0.5 * x**4), m)
    rate = (followed - state.symbol) / lag
    reset = ca.if_else(time_constant_min > 0, state.symbol, followed)
    extended = model.with_state(state, rate, at_rest=followed, reset=reset)
    return extended, followed + m / lag * (state.symbol - followed)


def window_states(name: str, unit: str, reach: float, scale: float) -> tuple[Variable, ...]:
    """Make the states of a delay: Legendre coefficients of the past.

    Args:
        name: prefix of their names.
        unit: unit of the delayed quantity.
        reach: largest magnitude of its values.
        scale: a typical magnitude of its changes.
    """
    bounds = (-reach, reach)
    return tuple(
        variable(f"{name}.window_{i}", unit, bounds, scale, f"Legendre coefficient {i} of the past")
        for i in range(COEFFICIENTS)
    )


def add_delay(
    model: ProcessModel, states: tuple[Variable, ...], delayed: ca.SX, delay_min: ca.SX
) -> tuple[ProcessModel, ca.SX]:
    """Add a delay to a model; returns the model and the delay's output.

    Args:
        model: the model that the states are added to.
        states: states of the delay, see `window_states`.
        delayed: the quantity that is delayed.
        delay_min: any expression; negative values count as 0.
    """
    q = [state.symbol for state in states]
    delay = nonnegative(delay_min)
    window = ca.fmax(delay, WINDOW_MIN)
    # The sum over j of a_ij q_j: all after i, and the alternating sum up to i, each carried along.
    after, alternating = sum(q, ca.SX(0)), ca.SX(0)
    for i, state in enumerate(states):
        after, alternating = after - q[i], q[i] - alternating
        rate = (2 * i + 1) / window * ((-1) ** i * delayed - after - alternating)
        model = model.with_state(state, rate, at_rest=delayed if i == 0 else ca.SX(0))
    x = 2 * delay / window - 1
    before, polynomial, result = ca.SX(0), ca.SX(1), delayed
    for i in range(len(states)):
        result = result + (polynomial - (-1) ** i) * q[i]
        before, polynomial = polynomial, ((2 * i + 1) * x * polynomial - i * before) / (i + 1)
    return model, result


def rest_function(model: ProcessModel) -> ca.Function:
    """(states that are not in `at_rest`, u, p, t) -> x, with all others in equilibrium."""
    _, u, p, t, x = model.at_one_time(ca.vertcat(*model.rest_expressions()))
    core = ca.vertcat(*(state.symbol for state in model.states if state.name not in model.at_rest))
    return ca.Function("rest", [core, u, p, t], [ca.densify(x)])


def reset_function(model: ProcessModel) -> ca.Function:
    """(x, u, p, t) -> x after the jumps at a row at t, from which on u holds."""
    after = ca.vertcat(*(model.resets.get(state.name, state.symbol) for state in model.states))
    *symbols, result = model.at_one_time(after)
    return ca.Function("reset", symbols, [ca.densify(result)])


def with_derivatives(function: ca.Function, *arguments: int) -> ca.Function:
    """Append the derivatives of the only result with respect to some arguments, given by index."""
    symbols = function.sx_in()
    result = function(*symbols)
    derivatives = (ca.densify(ca.jacobian(result, symbols[i])) for i in arguments)
    return ca.Function(function.name(), symbols, [result, *derivatives])
