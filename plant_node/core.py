"""The simulated plant: rows from equations, valve, sensors, scenario and faults. No clock, no bus.

Row k is measured at t_k = k periods, and its input is held until the next row. A change between two rows (an input, a
fault injected or cleared) acts from the next row on, whose time is `time_min`. Under temperature control the input of
row k is the controller's response to the measurement in row k. So the rows are a function of the configuration and of
the row that each command precedes, and of nothing else.

The plant may leave its operating branch, extinguish, ignite or run away: that is its physics, and the run continues.
While the equations cannot be integrated, the state is held and the rows are marked bad.
"""

from dataclasses import dataclass
from math import isfinite
from typing import Literal

import numpy as np
from msgspec.structs import asdict
from msgspec.structs import replace as with_changes

from plant_node.actuators import CoolantValve
from plant_node.config import PlantConfig
from plant_node.controllers import CONTROLLED, check_set_point
from plant_node.disturbances import process_noise
from plant_node.initial_state import complete_state, start_state
from plant_node.scenario import SIGNAL, Scenario
from plant_node.sensors import Sensor
from reactorwatch.arrays import Array
from reactorwatch.codegen.array_function import ArrayFunction
from reactorwatch.errors import InputError
from reactorwatch.process.effect import TIMING
from reactorwatch.process.fault import FaultSpecification
from reactorwatch.process.integrate import SimulationError, Stepper
from reactorwatch.process.level_control import with_level_control
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import to_minutes, to_time_ns

MAX_FAULTS = 32
"""Largest number of faults at a time: each makes the equations larger, and slower to compile."""


@dataclass(frozen=True)
class FaultChange:
    """A fault that has set in, or was cleared.

    Attributes:
        specification: the fault, with all parameters.
        onset_min: plant time at which it set in.
        active: whether it is in the plant now.
    """

    specification: FaultSpecification
    onset_min: float
    active: bool


@dataclass(frozen=True)
class Row:
    """The measurements of one time.

    Attributes:
        number: index of the row, from 0.
        time_min: plant time.
        readings: commanded inputs and measured outputs by signal, in its unit.
        good: false while the state is held because the equations could not be integrated.
        changes: faults that set in or were cleared since the row before.
    """

    number: int
    time_min: float
    readings: dict[str, float]
    good: bool
    changes: tuple[FaultChange, ...]


@dataclass(eq=False)
class _Installed:
    """A fault in the plant."""

    specification: FaultSpecification
    onset_min: float
    announced: bool = False


class Plant:
    """The simulated plant.

    Args:
        config: settings of the plant; those about pace and health are not used here.
        model: the process, without the faults of `config`.
        scenario: input of the plant.

    Raises:
        InputError: settings that do not fit the model.
    """

    def __init__(self, config: PlantConfig, model: ProcessModel, scenario: Scenario) -> None:
        if model.input_names != (SIGNAL,):
            raise InputError(f"{model.name}: a plant must have the one input {SIGNAL!r}, got {model.input_names}")
        lower, upper = config.valve_limits_l_min
        coolant = model.inputs[0]
        if not coolant.lower <= lower < upper <= coolant.upper:
            raise InputError(
                f"valve_limits_l_min must be in [{coolant.lower:g}, {coolant.upper:g}] l/min, "
                f"got {lower:g} and {upper:g}"
            )
        if config.level_control is not None:
            model = _with_level(model, config.level_control.gain_per_min)
        self.units = model.units
        self.trouble: str | None = None
        self._config = config
        self._base = model
        self._scenario = scenario
        self._valve = CoolantValve(lower, upper)
        noise_sd, resolution = asdict(config.noise_sd), asdict(config.resolution)
        self._sensors = [
            Sensor(signal, noise_sd.get(signal, 0.0), resolution.get(signal, 0.0), config.seed) for signal in self.units
        ]
        self._process_noise = process_noise(config.process_noise_sd, model, config.period_min, config.seed)
        self._number = 0
        self._held: Array | None = None
        self._control = config.temperature_control
        if self._control is not None:
            self._control.check(model, self._valve)
        self._manual_l_min: float | None = None
        self._cleared: list[FaultChange] = []
        self._installed = [_Installed(item, item.values.get("onset", 0.0)) for item in config.fault_specifications()]
        self._use(self._extend_model(self._installed))
        self._x = self._start()

    @property
    def number(self) -> int:
        """Index of the next row."""
        return self._number

    @property
    def time_min(self) -> float:
        """Plant time of the next row, from which on commands act."""
        return to_minutes(to_time_ns(self._number * self._config.period_min))

    @property
    def mode(self) -> Literal["open loop", "automatic", "manual"]:
        """Control mode of the coolant flow: by the scenario, by the temperature controller, or set in place of it."""
        if self._control is None:
            return "open loop"
        return "automatic" if self._manual_l_min is None else "manual"

    @property
    def state(self) -> dict[str, float]:
        """The true state at `time_min`, by name."""
        return dict(zip(self._model.state_names, self._x.tolist(), strict=True))

    @property
    def faults(self) -> tuple[FaultSpecification, ...]:
        """All faults in the plant, including those that have not set in yet."""
        return tuple(item.specification for item in self._installed)

    def next_row(self) -> Row:
        """Measure a row, and integrate to the next."""
        time_min, inputs = self.time_min, self._input()
        self._x, self._held = self._stepper.start_row(self._x, inputs, self._p, time_min), inputs
        row = Row(
            number=self._number,
            time_min=time_min,
            readings={
                sensor.signal: sensor.reading(float(value), self._number)
                for sensor, value in zip(self._sensors, (*inputs, *self._true_outputs(inputs)), strict=True)
            },
            good=self.trouble is None,
            changes=self._changes(time_min),
        )
        self._number += 1
        try:
            self._x = self._stepper.advance(self._x, inputs, self._p, time_min, self.time_min)
            for index, noise in self._process_noise:
                self._x[index] = noise.add_to(float(self._x[index]), self._number)
            self.trouble = None
        except SimulationError as error:
            self.trouble = str(error)
        return row

    def set_input(self, signal: str, value: float) -> None:
        """Hold an input at a value from the next row on, in place of the scenario or the controller.

        Under temperature control, `qc` switches the coolant flow to manual; and `T` sets the set point, constant from
        then on, and switches back to automatic.

        Raises:
            InputError: a signal that is not an input, or a value out of the range of the valve or the process.
        """
        if self._control is not None and signal == CONTROLLED:
            check_set_point(self._base, value)
            self._control = with_changes(self._control, set_point_K=value)
            self._manual_l_min = None
            return
        if signal != SIGNAL:
            valid = SIGNAL if self._control is None else f"{SIGNAL}, {CONTROLLED}"
            raise InputError(f"unknown input {signal!r} (valid: {valid})")
        if not (isfinite(value) and self._valve.reaches(value)):
            lower, upper = self._valve.lower_l_min, self._valve.upper_l_min
            raise InputError(f"{signal} must be in [{lower:g}, {upper:g}] l/min, got {value:g}")
        self._manual_l_min = value

    def inject(self, specification: FaultSpecification) -> FaultSpecification:
        """Inject a fault.

        Args:
            specification: the fault; its default onset is the next row, the default end of a ramp that of the run.

        Returns:
            The fault with all parameters.

        Raises:
            InputError: an onset in the past, a ramp without an end, a fault that does not fit the model, or too many
                faults.
        """
        fault = specification.with_defaults(self.time_min, self._config.duration_min)
        onset_min = fault.values.get("onset", self.time_min)
        if onset_min < self.time_min:
            raise InputError(
                f"fault {str(fault)!r}: onset must not lie before the plant's time, {self.time_min:g} min, "
                f"got {onset_min:g} min; leave it out for now"
            )
        if len(self._installed) >= MAX_FAULTS:
            raise InputError(f"there are {MAX_FAULTS} faults in the plant, which is the most; clear one")
        self._install([*self._installed, _Installed(fault, onset_min)])
        return fault

    def clear(self, cause: str) -> tuple[FaultSpecification, ...]:
        """Clear all faults of a cause, from the next row on.

        Returns:
            The cleared faults.

        Raises:
            InputError: there is no fault of that cause.
        """
        cleared = [item for item in self._installed if item.specification.effect.name == cause]
        if not cleared:
            there = sorted({item.specification.effect.name for item in self._installed})
            raise InputError(f"no fault {cause!r} is in the plant (there is: {', '.join(there) or 'none'})")
        self._install([item for item in self._installed if item not in cleared])
        self._cleared += [FaultChange(item.specification, item.onset_min, False) for item in cleared if item.announced]
        return tuple(item.specification for item in cleared)

    def _input(self) -> Array:
        command = self._manual_l_min
        if command is None and self._control is not None:
            # The temperature does not depend on this row's input, which is not known yet.
            outputs = self._true_outputs(np.array([self._control.base_flow_l_min]), self._controller_outputs)
            index = self._model.output_names.index(CONTROLLED)
            sensor = self._sensors[len(self._model.inputs) + index]
            temperature_K = sensor.reading(float(outputs[index]), self._number)
            command = self._control.command(temperature_K, self.time_min, self._dither())
        elif command is None:
            command = self._scenario.level(self.time_min, self._config.seed)
        return np.array([self._valve.flow(command)])

    def _dither(self) -> float:
        if self._control is None or not self._control.dither:
            return 0.0
        return self._scenario.level(self.time_min, self._config.seed) - self._scenario.mean

    def _start(self) -> Array:
        if self._control is None:
            return start_state(self._model, self._input(), self._config.start)
        base = np.array([self._control.base_flow_l_min + self._dither()])
        model = self._extend_model(self._physical(self._installed))
        return start_state(self._control.closed_loop(model, self._valve), base, self._config.start)

    def _true_outputs(self, inputs: Array, function: ArrayFunction | None = None) -> Array:
        function = function or self._outputs
        x, u, p, now, middle = function.arguments
        x[0], u[0], now[0], middle[0] = self._x, inputs, self.time_min, self.time_min
        p[0] = self._p[: p.size]  # the parameters of timing faults come last
        function()
        outputs: Array = function.results[1][0]
        return outputs

    def _changes(self, time_min: float) -> tuple[FaultChange, ...]:
        """Fault changes up to now that were not reported yet."""
        changes, self._cleared = self._cleared, []
        for item in self._installed:
            if not item.announced and item.onset_min <= time_min:
                item.announced = True
                changes.append(FaultChange(item.specification, item.onset_min, True))
        return tuple(changes)

    def _install(self, faults: list[_Installed]) -> None:
        """Continue from the present state with these faults; nothing changes if they are invalid."""
        model = self._extend_model(faults)
        held = self._input() if self._held is None else self._held
        self._x = complete_state(model, self.state, held, self.time_min)
        self._installed = faults
        self._use(model)

    def _physical(self, faults: list[_Installed]) -> list[_Installed]:
        """Faults of the plant, without those of the timestamps, which a controller does not see."""
        return [fault for fault in faults if fault.specification.effect.location != TIMING]

    def _extend_model(self, faults: list[_Installed]) -> ProcessModel:
        """The model with these faults; the physical ones come first, as timing faults shift their times."""
        model = self._base
        physical = self._physical(faults)
        for fault in (*physical, *(fault for fault in faults if fault not in physical)):
            try:
                model = fault.specification.extend(model)
            except ValueError as error:
                raise InputError(f"fault {str(fault.specification)!r}: {error}") from error
        return model

    def _use(self, model: ProcessModel) -> None:
        self._model, self._p = model, model.values()
        self._stepper, self._outputs = Stepper(model), ArrayFunction(model.function("outputs"))
        physical = self._extend_model(self._physical(self._installed))
        self._controller_outputs = ArrayFunction(physical.function("outputs"))


def _with_level(model: ProcessModel, gain_per_min: float) -> ProcessModel:
    try:
        return with_level_control(model, gain_per_min)
    except ValueError as error:
        raise InputError(f"level_control: {error}") from error
