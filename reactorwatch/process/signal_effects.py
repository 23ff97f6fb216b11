"""Effects on one signal of any model: between the command of an input and the process, on a sensor, on the timestamps.

Lags and delays add states. A lag z of a quantity y with time constant m, dz/dt = (y - z)/m, is arbitrarily stiff for
m -> 0. So below `QUICK_MIN` the state's time constant M is larger than m, and the output takes only a share of it,

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

less the sum's error at m = 0. Up to 1 min the window does not depend on m, so the delay may set in, grow and
disappear, and the polynomials have a derivative with respect to m at zero.
"""

from dataclasses import replace
from typing import ClassVar

import casadi as ca

from reactorwatch.process.effect import TIMING, Effect, SensorEffect
from reactorwatch.process.model import Clock, ProcessModel, Variable, variable
from reactorwatch.process.profiles import Profile
from reactorwatch.process.simulate import symbolic_step

QUICK_MIN = 0.07
"""Half of this is 0.7 of the longest step of the integrator, so a lag is never stiff: a step's error is 0.001 of the
followed value. With 0.1 min a lag of 0.03 min erred by a tenth of the sensors' noise, which 7,500 rows reveal."""

COEFFICIENTS = 10
"""Number of Legendre polynomials of a delay. With the reactor's coolant stepping every minute over its whole range, the
analyser's error is 0.0001 mol/l (root mean square) for delays up to 1 min, 0.001 at 2 min, 0.003 at 3 min."""

UNBOUNDED = 1e6
"""Scales of an output beyond which its sensor's states are not."""


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
    """States of a delay, Legendre coefficients of the past; `reach` bounds the delayed quantity."""
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
    window = ca.fmax(delay, 1.0)  # the past that the states represent, at least
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


class InputEffect(Effect):
    """An effect on one input.

    Attributes:
        input: name of the input.
    """

    input: ClassVar[str]

    def command(self, model: ProcessModel) -> Variable:
        """The input as it is commanded.

        Raises:
            ValueError: the model has no such input.
        """
        for item in model.inputs:
            if item.name == self.input:
                return item
        raise ValueError(
            f"{self.name} needs a model with the input {self.input!r}, {model.name} has {model.input_names}"
        )

    def new_state(self, model: ProcessModel) -> Variable:
        """State of the real input, in the range of its command."""
        command = self.command(model)
        bounds = (command.lower, command.upper)
        return variable(f"{self.prefix(model)}.real", command.unit, bounds, command.scale, f"real {command.meaning}")


class InputGain(InputEffect):
    """The real input is its command times (1 + m)."""

    unit = "1"
    lower = -0.99
    upper = 4.0
    typical = 0.02

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        command = self.command(model).symbol
        return model.substitute(command, command * (1 + size))


class InputOffset(InputEffect):
    """The real input is its command plus m."""

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        command = self.command(model).symbol
        return model.substitute(command, command + size)


class InputLag(InputEffect):
    """The real input follows its command with a time constant of m."""

    unit = "min"
    lower = 0.0
    upper = 10.0
    typical = 0.1
    start_values = (0.05, 0.5)

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        state, command = self.new_state(model), self.command(model).symbol
        _, real = add_lag(model, state, command, size)
        return add_lag(model.substitute(command, real), state, command, size)[0]


class InputDelay(InputEffect):
    """The real input is its command m before."""

    unit = "min"
    lower = 0.0
    upper = 3.0
    typical = 0.2
    start_values = (0.1, 0.5, 1.5)

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        command = self.command(model)
        reach = max(abs(command.lower), abs(command.upper))
        states = window_states(self.prefix(model), command.unit, reach, command.scale)
        _, real = add_delay(model, states, command.symbol, size)
        return add_delay(model.substitute(command.symbol, real), states, command.symbol, size)[0]


class InputStiction(InputEffect):
    """The real input moves only when its command is more than m away from it; then it goes to the command.

    It moves when a row begins, as the command is constant between rows. The real input is a state that jumps then and
    is constant in between. A simulation is the same for all m between two changes of the command that occur in a
    record. So its derivative with respect to m is zero, and a fit has to scan m.
    """

    lower = 0.0
    is_discontinuous = True

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        state, command = replace(self.new_state(model), scale=self.typical), self.command(model).symbol
        free = ca.logic_or(ca.fabs(command - state.symbol) > size, size <= 0)
        moved = ca.if_else(free, command, state.symbol)
        stuck = model.substitute(command, state.symbol)
        # Other states that jump at this row see the new position.
        stuck = replace(stuck, resets=model.substitute(command, moved).resets)
        return stuck.with_state(state, ca.SX(0), at_rest=command, reset=moved)


class OutputBias(SensorEffect):
    """The reading is the true value plus m."""

    def sense(self, model: ProcessModel, value: ca.SX, size: ca.SX) -> tuple[ProcessModel, ca.SX]:
        """See `SensorEffect`."""
        return model, value + size


class OutputGain(SensorEffect):
    """The reading is the true value times (1 + m)."""

    unit = "1"
    lower = -0.99
    upper = 4.0
    typical = 0.1

    def sense(self, model: ProcessModel, value: ca.SX, size: ca.SX) -> tuple[ProcessModel, ca.SX]:
        """See `SensorEffect`."""
        return model, value * (1 + size)


class OutputLag(SensorEffect):
    """The reading follows the true value with a time constant of m.

    Attributes:
        scale: a typical magnitude of the output's changes.
    """

    unit = "min"
    lower = 0.0
    upper = 10.0
    typical = 0.1
    start_values = (0.05, 0.5)
    scale: ClassVar[float]

    def sense(self, model: ProcessModel, value: ca.SX, size: ca.SX) -> tuple[ProcessModel, ca.SX]:
        """See `SensorEffect`."""
        name = f"{self.prefix(model)}.reading"
        reach = UNBOUNDED * self.scale
        reading = variable(name, model.units[self.output], (-reach, reach), self.scale, "reading of the sensor")
        return add_lag(model, reading, value, size)


class OutputDelay(SensorEffect):
    """The reading is the true value m before.

    Attributes:
        scale: a typical magnitude of the output's changes.
    """

    unit = "min"
    lower = 0.0
    upper = 3.0
    typical = 0.2
    start_values = (0.1, 0.5, 1.5)
    scale: ClassVar[float]

    def sense(self, model: ProcessModel, value: ca.SX, size: ca.SX) -> tuple[ProcessModel, ca.SX]:
        """See `SensorEffect`."""
        states = window_states(self.prefix(model), model.units[self.output], UNBOUNDED * self.scale, self.scale)
        return add_delay(model, states, value, size)


class StuckOutput(SensorEffect):
    """The share m of the reading stays at a constant value: 1 is a sensor that is stuck.

    The constant is a parameter of the extended model. A monitor finds a stuck sensor by its repeated values.
    """

    is_traced = False
    unit = "1"
    lower = 0.0
    upper = 1.0
    typical = 1.0
    start_values = (1.0,)

    def sense(self, model: ProcessModel, value: ca.SX, size: ca.SX) -> tuple[ProcessModel, ca.SX]:
        """See `SensorEffect`."""
        extended, (constant,) = self.add_constants(model)
        return extended, value + size * (constant - value)


class OutputNoise(SensorEffect):
    """The reading carries further white noise with a standard deviation of m."""

    is_noise = True
    lower = 0.0

    def sense(self, model: ProcessModel, value: ca.SX, size: ca.SX) -> tuple[ProcessModel, ca.SX]:
        """See `SensorEffect`."""
        output = model.output(self.output)
        before = ca.SX(0) if output.noise_variance is None else output.noise_variance
        return model.with_output(replace(output, noise_variance=before + size**2)), value


class InputTiming(Effect):
    """The input of a row has acted on the plant for m when the row is measured.

    At any time t the plant responds to the input stamped t + m(t); the timestamps of the measurements are right. The
    state of a row is that at the time from which on its input acts, m before the row, and the measurement is m later:
    y_k = h(Phi_m(x_k, u_k)). So while m grows, the states' time step is shorter than the clock's by m's growth
    (`ProcessModel.time_offset`). A shift cannot act before its onset, so m is at most the time since then, during which
    the states stand still. That is exact for a constant m and for a step, however irregular the rows, as long as m is
    at most the time until the next row; a larger m would need the input of later rows. For a slowly growing profile m
    is evaluated at the row instead of m before it, an error of m times its growth.

    To first order, an input that is interpolated between the rows is one that is held, with m of half a period.

    Among the effects of a model this must be the last: its outputs are those of the model that it is applied to, m
    later, and the onsets of the others are in that model's time.
    """

    is_traced = False
    location = TIMING
    unit = "min"
    lower = 0.0
    upper = 0.5
    typical = 0.05

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`; m is two steps of integration."""
        x, u, p = model.arguments()
        clock = model.clock
        step, shown = symbolic_step(model), model.function("shown")
        late = nonnegative(size)
        h = late / 2
        for i in range(2):
            x = step(x, u, p, clock.now + i * h, clock.middle, h)[0]
        later = ca.vertsplit(shown(x, u, p, clock.now + late, clock.middle)[1])
        return replace(
            model,
            outputs=tuple(replace(item, expression=y) for item, y in zip(model.outputs, later, strict=True)),
            time_offset=model.time_offset + size,
        )

    def size_signal(self, clock: Clock, profile: Profile, symbols: dict[str, ca.SX]) -> ca.SX:
        """See `Effect`; at most the time since the onset."""
        late = nonnegative(super().size_signal(clock, profile, symbols))
        if "onset" not in symbols:
            return late
        return ca.fmin(late, ca.fmax(clock.now - symbols["onset"], 0))
