"""States that effects add to a model: initial values, jumps, and the first-order lag.

A lag z of a quantity y with time constant m, dz/dt = (y - z)/m, is arbitrarily stiff for m -> 0. So below `QUICK_MIN`
the state's time constant M is larger than m, and the output takes only a share of it,

    dz/dt = (y - z) / M(m),    output = y + m/M(m) (z - y),

where M is m itself from `QUICK_MIN` on and half of that at m = 0, with two continuous derivatives between. The output
lags behind a ramp by m for any m; at m = 0 it is y itself, to the last bit, and approaches it as smoothly as the true
lag. While m is 0 the state is reset to y at every row, so a lag that sets in starts at y, except for y's change since
the row began.
"""

import casadi as ca

from reactorwatch.process.model import ProcessModel, Variable

QUICK_MIN = 0.07
"""Half of this is 0.7 of the longest step of the integrator, so a lag is never stiff: a step's error is 0.001 of the
followed value. With 0.1 min a lag of 0.03 min erred by a tenth of the sensors' noise, which 7,500 rows reveal."""


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


def rest_function(model: ProcessModel) -> ca.Function:
    """(states that are not in `at_rest`, u, p, t) -> x, with all others in equilibrium."""
    symbols, results = _at_one_time(model, ca.vertcat(*model.rest_expressions()))
    symbols[0] = ca.vertcat(*(state.symbol for state in model.states if state.name not in model.at_rest))
    return ca.Function("rest", symbols, [ca.densify(results)])


def reset_function(model: ProcessModel) -> ca.Function:
    """(x, u, p, t) -> x after the jumps at a row at t, from which on u holds."""
    after = ca.vertcat(*(model.resets.get(state.name, state.symbol) for state in model.states))
    symbols, result = _at_one_time(model, after)
    return ca.Function("reset", symbols, [ca.densify(result)])


def _at_one_time(model: ProcessModel, expression: ca.SX) -> tuple[list[ca.SX], ca.SX]:
    t = ca.SX.sym("t")
    (result,) = ca.substitute([expression], [model.clock.now, model.clock.middle], [t, t])
    return [*model.arguments(), t], result


def with_derivatives(function: ca.Function, *arguments: int) -> ca.Function:
    """Append the derivatives of the only result with respect to some arguments, given by index."""
    symbols = function.sx_in()
    result = function(*symbols)
    derivatives = (ca.densify(ca.jacobian(result, symbols[i])) for i in arguments)
    return ca.Function(function.name(), symbols, [result, *derivatives])
