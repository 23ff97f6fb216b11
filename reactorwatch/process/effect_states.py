"""The memory that effects bring into a model: where it begins, how it jumps, and the lag of first order.

A lag z of a quantity y with time constant m, dz/dt = (y - z)/m, has no limit that a solver could follow for m -> 0. So
below `QUICK_MIN` the state lags by more than m, and only a share of it shows,

    dz/dt = (y - z) / M(m),    shown = y + m/M(m) (z - y),

where M is m itself from `QUICK_MIN` on and half of that at m = 0, with two continuous derivatives between. What is
shown lags behind a ramp by m whatever m is; it is y itself at m = 0, to the last bit, and goes there as evenly as the
true lag. While m is 0 the state begins every row at y, so a lag that sets in begins with what is there, but for what y
has moved since the row began.
"""

import casadi as ca

from reactorwatch.process.model import ProcessModel, Variable

QUICK_MIN = 0.07
"""Half of this is 0.7 of the longest step of the integrator, so a lag is never stiff: a step is right to 0.001 of what
it follows. With 0.1 min a lag of 0.03 min was off by a tenth of the noise of the sensors, which 7,500 rows tell."""


def positive(size: ca.SX) -> ca.SX:
    """The size, but nothing where it is negative; with a derivative of 1 at zero, where a fit begins."""
    return ca.if_else(size >= 0, size, 0)


def lagged(
    model: ProcessModel, state: Variable, followed: ca.SX, time_constant_min: ca.SX
) -> tuple[ProcessModel, ca.SX]:
    """The model with a lag in it, and what the lag shows.

    Args:
        model: to which the state is added.
        state: what follows.
        followed: what it follows.
        time_constant_min: of any size; where negative it counts as 0.
    """
    m = positive(time_constant_min)
    x = ca.fmin(m / QUICK_MIN, 1)
    lag = ca.if_else(m < QUICK_MIN, QUICK_MIN * (0.5 + x**3 - 0.5 * x**4), m)
    rate = (followed - state.symbol) / lag
    begun = ca.if_else(time_constant_min > 0, state.symbol, followed)
    extended = model.with_state(state, rate, at_rest=followed, reset=begun)
    return extended, followed + m / lag * (state.symbol - followed)


def rest_function(model: ProcessModel) -> ca.Function:
    """(values of the states that are not in `at_rest`, u, p, t) -> x, with all others at rest."""
    symbols, results = _at_one_time(model, ca.vertcat(*model.at_rest_states()))
    symbols[0] = ca.vertcat(*(state.symbol for state in model.states if state.name not in model.at_rest))
    return ca.Function("rest", symbols, [ca.densify(results)])


def reset_function(model: ProcessModel) -> ca.Function:
    """(x, u, p, t) -> x as it is when a row begins at t, from which on u holds."""
    after = ca.vertcat(*(model.resets.get(state.name, state.symbol) for state in model.states))
    symbols, result = _at_one_time(model, after)
    return ca.Function("reset", symbols, [ca.densify(result)])


def _at_one_time(model: ProcessModel, expression: ca.SX) -> tuple[list[ca.SX], ca.SX]:
    t = ca.SX.sym("t")
    (result,) = ca.substitute([expression], [model.clock.now, model.clock.middle], [t, t])
    return [*model.arguments(), t], result
