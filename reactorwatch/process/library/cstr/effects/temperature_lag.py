"""Lag of the temperature sensor."""

import casadi as ca

from reactorwatch.process.effect import SensorEffect
from reactorwatch.process.effect_states import add_lag
from reactorwatch.process.model import ProcessModel, variable


class TemperatureLag(SensorEffect):
    """The measured temperature follows T with a time constant of m, as in a thermowell."""

    name = "temperature_lag"
    label = "slow thermometer"
    location = "temperature_sensor"
    unit = "min"
    larger = "thermometer follows with a time constant of {} min"
    lower = 0.0
    upper = 10.0
    typical = 0.1
    start_values = (0.05, 0.5)
    output = "T"

    def sense(self, model: ProcessModel, value: ca.SX, size: ca.SX) -> tuple[ProcessModel, ca.SX]:
        """See `SensorEffect`."""
        well = variable(f"{self.prefix(model)}.well", "K", (150.0, 800.0), 10.0, "temperature in the thermowell")
        return add_lag(model, well, value, size)
