"""The simulated plant: rows from equations, actuators, sensors, scenarios and faults. No clock, no bus.

Row k is measured at t_k = k periods, and its inputs are held until the next row. A change between two rows (an input, a
fault injected or cleared) acts from the next row on, whose time is `time_min`. Under control the input of row k is the
controller's response to the measurement in row k. So the rows are a function of the configuration and of the row that
each command precedes, and of nothing else.

The plant may leave its operating branch (the reactor may extinguish, ignite or run away): that is its physics, and the
run continues.
While the equations cannot be integrated, the state is held and the rows are marked bad.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite, sqrt
from typing import Literal

import numpy as np

from plant_node.config import PlantConfig, ProcessSettings, to_model_unit
from plant_node.instruments import ControlLoop, ProcessNoise, check_controller, check_set_point, close_loops
from plant_node.scenario import Scenario, seed_of_input
from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import ArrayFunction
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError, prefix_errors
from reactorwatch.process.effect import TIMING
from reactorwatch.process.fault import FaultSpecification
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import SimulationError, Stepper
from reactorwatch.process.steady_state import complete_state, start_state
from reactorwatch.records.record import to_minutes, to_time_ns

MAX_FAULTS = 32
"""Largest number of faults at a time: each makes the equations larger, and slower to compile."""


@dataclass(frozen=True)
class FaultChange:
    """A fault of the plant, which sets in and may be cleared.

    Attributes:
        specification: the fault, with all parameters.
        onset_min: plant time at which it sets in.
        active: true from its onset until it is cleared.
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


class Plant:
    """The simulated plant.

    Args:
        config: settings of the plant; those about pace and health are not used here.
        process: the process, without the faults of `config`.
        settings: settings of the plant as the process has them.
        scenarios: programme of each input, by name.

    Attributes:
        number: index of the next row.
        effects: effects that can be faults of the plant.
        units: units of the signals, by name, in which they are published.
        trouble: reason why the equations could not be integrated; None: they could.

    Raises:
        InputError: settings that do not fit the process.
    """

    def __init__(
        self, config: PlantConfig, process: Process, settings: ProcessSettings, scenarios: Mapping[str, Scenario]
    ) -> None:
        model = settings.equations
        signals = {signal.name: signal for signal in process.signals}
        self.units = {name: signals[name].unit or unit for name, unit in model.units.items()}
        self.trouble: str | None = None
        self._scales = {name: to_model_unit(signals[name], model) for name in model.units}
        self.effects = process.faults
        self.number = 0
        self._config = config
        self._base = model
        self._scenarios = [scenarios[name] for name in model.input_names]
        self._seeds = [seed_of_input(config.seed, index) for index in range(len(model.inputs))]
        self._actuators = settings.actuators
        self._manual: dict[str, float] = {}  # of inputs without a controller
        self._sensors = list(settings.sensors.values())
        for name in config.process_noise_sd:
            if name not in model.state_names:
                valid = ", ".join(model.state_names)
                raise InputError(f"process_noise_sd: {model.name} has no state {name!r} (valid: {valid})")
        self._process_noise = [  # states of faults come after those of the process
            (index, ProcessNoise(state, sd * sqrt(config.period_min), config.seed))
            for index, state in enumerate(model.states)
            if (sd := config.process_noise_sd.get(state.name, 0.0))
        ]
        self._held: Array | None = None
        for control in settings.controllers.values():
            check_controller(control, model, settings.actuators.get(control.input))
        self._loops = {
            name: ControlLoop(settings.controllers[name], settings.actuators[name])
            for name in model.input_names
            if name in settings.controllers
        }
        self._cleared: list[FaultChange] = []
        self._installed = [FaultChange(item, item.values.get("onset", 0.0), False) for item in settings.faults]
        self._use(self._extend_model(self._installed))
        self._x = self._start()

    @property
    def time_min(self) -> float:
        """Plant time of the next row, from which on commands act."""
        return to_minutes(to_time_ns(self.number * self._config.period_min))

    @property
    def mode(self) -> Literal["open loop", "automatic", "manual"]:
        """Control mode: by the scenarios, by controllers, or with an input set in place of its controller."""
        if not self._loops:
            return "open loop"
        return "automatic" if all(loop.manual is None for loop in self._loops.values()) else "manual"

    @property
    def state(self) -> dict[str, float]:
        """The true state at `time_min`, by name."""
        return dict(zip(self._model.state_names, self._x.tolist(), strict=True))

    def next_row(self) -> Row:
        """Measure a row, and integrate to the next."""
        time_min, inputs = self.time_min, self._inputs(advance=True)
        self._x, self._held = self._stepper.start_row(self._x, inputs, self._p, time_min), inputs
        sensors = zip(self._sensors, inputs, strict=False)  # those of the inputs come first
        read = {sensor.signal: sensor.reading(float(value), self.number) for sensor, value in sensors}
        read |= self._read_outputs(inputs, self._outputs)
        readings = {signal: self._publish(signal, value) for signal, value in read.items()}
        row = Row(self.number, time_min, readings, self.trouble is None, self._changes(time_min))
        self.number += 1
        try:
            self._x = self._stepper.advance(self._x, inputs, self._p, time_min, self.time_min)
            for index, noise in self._process_noise:
                self._x[index] = noise.add_to(float(self._x[index]), self.number)
            self.trouble = None
        except SimulationError as error:
            self.trouble = str(error)
        return row

    def set_input(self, signal: str, value: float) -> None:
        """Hold an input at a value from the next row on, in place of its scenario or controller.

        An input with a controller is then on manual. A controlled output sets the set point of its controller, constant
        from then on, and switches back to automatic.

        Args:
            signal: name of the input or controlled output.
            value: level in the unit in which the signal is published.

        Raises:
            InputError: any other signal, or a value out of the range of the actuator or the process.
        """
        controlled = {loop.controller.output: name for name, loop in self._loops.items()}
        if signal not in self._base.input_names and signal not in controlled:
            raise InputError(f"unknown input {signal!r} (valid: {', '.join((*self._base.input_names, *controlled))})")
        scale, offset = self._scales[signal]
        level = scale * value + offset
        if signal in controlled:
            check_set_point(self._base, signal, level)
            name = controlled[signal]
            self._loops[name] = self._loops[name].with_set_point(level)
            return
        actuator = self._actuators[signal]
        if not (isfinite(value) and actuator.reaches(level)):
            lower, upper = (self._publish(signal, bound) for bound in (actuator.lower, actuator.upper))
            raise InputError(f"{signal} must be in [{lower:g}, {upper:g}] {self.units[signal]}, got {value:g}")
        if signal in self._loops:
            self._loops[signal] = replace(self._loops[signal], manual=level)
        else:
            self._manual[signal] = level

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
        self._install([*self._installed, FaultChange(fault, onset_min, False)])
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
        self._install([item for item in self._installed if item.specification.effect.name != cause])
        self._cleared += [replace(item, active=False) for item in cleared if item.active]
        return tuple(item.specification for item in cleared)

    def _inputs(self, *, advance: bool = False) -> Array:
        """Inputs of the next row, limited by their actuators; `advance` takes the control loops to the row after it."""
        # Controllers act on outputs that do not depend on this row's inputs, which are not known yet.
        measured = self._read_outputs(self._base_inputs(), self._controller_outputs) if self._loops else {}
        commands: list[float] = []
        for index, name in enumerate(self._base.input_names):
            loop = self._loops.get(name)
            if loop is None:
                commands.append(self._actuators[name].limit(self._manual.get(name, self._level(index))))
                continue
            reading, dither = measured[loop.controller.output], self._dither(index)
            command, after = loop.step(reading, self.time_min, dither, self._config.period_min)
            commands.append(command)
            if advance:
                self._loops[name] = after
        return np.array(commands)

    def _read_outputs(self, inputs: Array, function: ArrayFunction) -> dict[str, float]:
        """Readings of the next row by output, at these inputs."""
        x, u, p, now, middle = function.arguments
        x[0], u[0], now[0], middle[0] = self._x, inputs, self.time_min, self.time_min
        p[0] = self._p[: p.size]  # the parameters of timing faults come last
        function()
        beyond = [0.0] * len(self._base.outputs)  # variances of the noise beyond the sensors' own
        if self._noise is not None:
            beyond = np.array(self._noise(inputs, self._p, self.time_min)).ravel().tolist()
        outputs = zip(self._sensors[len(inputs) :], function.results[1][0], beyond, strict=True)
        return {sensor.signal: sensor.reading(float(value), self.number, more) for sensor, value, more in outputs}

    def _base_inputs(self) -> Array:
        """Inputs without feedback: base and dither of controlled ones, levels of the others."""
        return np.array(
            [
                self._loops[name].controller.base + self._dither(index) if name in self._loops else self._level(index)
                for index, name in enumerate(self._base.input_names)
            ]
        )

    def _level(self, index: int) -> float:
        return self._scenarios[index].level(self.time_min, self._seeds[index])

    def _dither(self, index: int) -> float:
        loop = self._loops[self._base.input_names[index]]
        return self._level(index) - self._scenarios[index].mean if loop.controller.dither else 0.0

    def _publish(self, signal: str, value: float) -> float:
        """Value in the unit in which a signal is published."""
        scale, offset = self._scales[signal]
        return (value - offset) / scale

    def _start(self) -> Array:
        start = self._config.start
        if not self._loops:
            return start_state(self._model, self._inputs(), start)
        model, loops = self._extend_model(self._physical(self._installed)), tuple(self._loops.values())
        closed = close_loops(model, loops, integral=isinstance(start, str))
        state = start_state(closed, self._base_inputs(), start)
        integral = [loop.controller.input for loop in loops if loop.controller.is_integral]
        for name, value in zip(integral, state[len(model.states) :].tolist(), strict=False):
            self._loops[name] = replace(self._loops[name], integral=value)
        return state[: len(model.states)]

    def _changes(self, time_min: float) -> tuple[FaultChange, ...]:
        """Fault changes up to now that were not reported yet."""
        changes, self._cleared = self._cleared, []
        for index, item in enumerate(self._installed):
            if not item.active and item.onset_min <= time_min:
                self._installed[index] = replace(item, active=True)
                changes.append(self._installed[index])
        return tuple(changes)

    def _install(self, faults: list[FaultChange]) -> None:
        """Continue from the present state with these faults; nothing changes if they are invalid."""
        model = self._extend_model(faults)
        held = self._inputs() if self._held is None else self._held
        self._x = complete_state(model, self.state, held, self.time_min)
        self._installed = faults
        self._use(model)

    def _physical(self, faults: list[FaultChange]) -> list[FaultChange]:
        """Faults of the plant, without those of the timestamps, which a controller does not see."""
        return [fault for fault in faults if fault.specification.effect.location != TIMING]

    def _extend_model(self, faults: list[FaultChange]) -> ProcessModel:
        """The model with these faults; the physical ones come first, as timing faults shift their times."""
        model = self._base
        for fault in sorted(faults, key=lambda item: item.specification.effect.location == TIMING):
            with prefix_errors(f"fault {str(fault.specification)!r}", ValueError):
                model = fault.specification.extend(model)
        return model

    def _use(self, model: ProcessModel) -> None:
        self._model, self._p = model, model.values()
        self._stepper, self._outputs = Stepper(model), ArrayFunction(model.function("outputs"))
        self._noise = model.noise_function()
        physical = self._extend_model(self._physical(self._installed))
        self._controller_outputs = ArrayFunction(physical.function("outputs"))
