"""Settings of the plant completed by its process: programmes, controllers, faults, sensors and actuators. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec
from msgspec.structs import replace as with_changes

from plant_node.actuators import Actuator
from plant_node.config import PlantConfig
from plant_node.scenario import Settings, check_levels, scenario_settings, split_scenarios
from reactorwatch.description.process import Process, Signal
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.process.controller import ContinuousController, Controller
from reactorwatch.process.fault import FaultSpecification, parse_fault
from reactorwatch.process.library.cstr.controllers import TemperatureControl
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.operation import InputLevels
from reactorwatch.units import conversion

Bounds = tuple[float, float]


@dataclass(frozen=True)
class ProcessSettings:
    """Settings of the plant as its process has them, in the units of the equations.

    Attributes:
        scenarios: programme of each input, by name.
        controllers: controllers that act once a row, by input.
        equations: the model, with the controllers that act in continuous time.
        faults: faults that are in the plant from the start.
        actuators: actuator of each input, by name.
        noise_sd: standard deviation of each sensor's noise, by signal.
        resolution: resolution of each sensor, by signal; 0: continuous.
    """

    scenarios: Mapping[str, Settings]
    controllers: Mapping[str, Controller]
    equations: ProcessModel
    faults: tuple[FaultSpecification, ...]
    actuators: Mapping[str, Actuator]
    noise_sd: Mapping[str, float]
    resolution: Mapping[str, float]

    def complete(self, config: PlantConfig) -> PlantConfig:
        """Copy of settings in which what the process decides is written out."""
        return with_changes(
            config,
            noise_sd=dict(self.noise_sd),
            resolution=dict(self.resolution),
            limits={name: (item.lower, item.upper) for name, item in self.actuators.items()},
            valve_limits_l_min=None,
        )


def fit_settings(config: PlantConfig, process: Process) -> ProcessSettings:
    """Complete settings by a process.

    Raises:
        InputError: a setting names something that the process lacks, or breaks a rule; or it has no equations.
    """
    model = process.require_model()
    try:
        controllers, model = _controllers(config, process, model)
        return ProcessSettings(
            _scenarios(config, process, model),
            controllers,
            model,
            tuple(parse_fault(text, process.faults).with_defaults(0.0, config.duration_min) for text in config.faults),
            _actuators(config, process, model),
            _by_signal("noise_sd", config.noise_sd, process.operation.noise_sd, model),
            _by_signal("resolution", config.resolution, _resolutions(process), model),
        )
    except (InputError, msgspec.ValidationError) as error:
        raise InputError(f"settings [plant]: {error}") from error


def to_model_unit(signal: Signal, model: ProcessModel) -> tuple[float, float]:
    """Scale and offset from the unit of a signal to that of the equations."""
    unit = model.units[signal.name]
    return (1.0, 0.0) if signal.unit in ("", unit) else conversion(signal.unit, unit, f"signal {signal.name!r}")


def _scenarios(config: PlantConfig, process: Process, model: ProcessModel) -> dict[str, Settings]:
    given = split_scenarios(config.scenario, model.input_names)
    bounds = _bounds(process, model)
    found = {}
    for item in model.inputs:
        levels = process.operation.inputs.get(item.name) or InputLevels.of(item, bounds[item.name])
        found[item.name] = scenario_settings(given[item.name], levels)
        check_levels(found[item.name], item)
    return found


def _controllers(
    config: PlantConfig, process: Process, model: ProcessModel
) -> tuple[dict[str, Controller], ProcessModel]:
    """Controllers that act once a row, by input, and the model with the others."""
    found: dict[str, Controller] = {}
    own = () if config.open_loop else process.controllers
    for item in (*own, *filter(None, (config.temperature_control, config.level_control))):
        if isinstance(item, TemperatureControl):
            item = item.controller()
        if isinstance(item, Controller):
            found[item.input] = item
        elif isinstance(item, ContinuousController):
            try:
                model = item.extend(model)
            except ValueError as error:
                name = "level_control" if item is config.level_control else type(item).__name__
                raise InputError(f"{name}: {error}") from error
        else:
            raise InputError(
                f"process {process.name!r}: a controller must be a Controller, or have extend(model), "
                f"got {type(item).__name__}"
            )
    for name, table in config.controllers.items():
        if name not in model.input_names:
            raise InputError(f"controllers: {describe_unknown('input', name, model.input_names)}")
        known: Mapping[str, Any] = {} if name not in found else msgspec.structs.asdict(found[name])
        try:
            found[name] = msgspec.convert({**known, **table, "input": name}, Controller)
        except msgspec.ValidationError as error:
            raise InputError(f"controllers: {name}: {error}") from error
    return found, model


def _bounds(process: Process, model: ProcessModel) -> dict[str, Bounds]:
    """Bounds of each input: of its signal, else of the equations."""
    signals = {signal.name: signal for signal in process.signals}
    found = {}
    for item in model.inputs:
        signal = signals[item.name]
        found[item.name] = (item.lower, item.upper)
        if signal.bounds is not None:
            scale, offset = to_model_unit(signal, model)
            low, high = sorted(scale * bound + offset for bound in signal.bounds)
            found[item.name] = (max(low, item.lower), min(high, item.upper))
    return found


def _actuators(config: PlantConfig, process: Process, model: ProcessModel) -> dict[str, Actuator]:
    limits = dict(config.limits)
    if config.valve_limits_l_min is not None:
        if len(model.inputs) != 1:
            raise InputError(
                f"valve_limits_l_min is for a process with one input, got {', '.join(model.input_names)}; "
                "give limits by input"
            )
        limits = {model.input_names[0]: config.valve_limits_l_min, **limits}
    for name, (lower, upper) in limits.items():
        if name not in model.input_names:
            raise InputError(f"limits: {describe_unknown('input', name, model.input_names)}")
        item = model.inputs[model.input_names.index(name)]
        if not item.lower <= lower < upper <= item.upper:
            raise InputError(
                f"limits of {name} must be in [{item.lower:g}, {item.upper:g}] {item.unit}, got {lower:g} and {upper:g}"
            )
    return {name: Actuator(*limits.get(name, bounds)) for name, bounds in _bounds(process, model).items()}


def _resolutions(process: Process) -> dict[str, float]:
    """Resolutions of the signals of the equations, in the units of the equations."""
    model = process.require_model()
    return {
        signal.name: abs(to_model_unit(signal, model)[0]) * signal.resolution
        for signal in process.signals
        if signal.resolution is not None and signal.name in model.units
    }


def _by_signal(
    name: str, given: Mapping[str, float], defaults: Mapping[str, float], model: ProcessModel
) -> dict[str, float]:
    for signal in given:
        if signal not in model.units:
            raise InputError(f"{name}: {describe_unknown('signal', signal, tuple(model.units))}")
    return {signal: given.get(signal, defaults.get(signal, 0.0)) for signal in model.units}
