"""Effects on the sensor of one output of any model: bias, gain, lag, delay, a stuck reading, noise."""

from dataclasses import replace
from typing import ClassVar

import casadi as ca

from reactorwatch.process.effect import SensorEffect
from reactorwatch.process.effect_states import add_delay, add_lag, window_states
from reactorwatch.process.model import ProcessModel, variable


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

    The constant is a parameter of the extended model.
    """

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


UNBOUNDED = 1e6
"""Scales of an output beyond which its sensor's states are not."""
