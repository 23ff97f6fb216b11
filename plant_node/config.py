"""The plant's settings, and those that its process completes: programmes, controllers, faults and actuators."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec.structs import replace as with_changes

from plant_node.instruments import Actuator, Sensor
from plant_node.scenario import Settings, check_levels, scenario_settings, split_scenarios
from reactorwatch.contract.keys import DEFAULT_PLANT, check_plant
from reactorwatch.description.process import Process, Signal
from reactorwatch.errors import InputError, describe_unknown, prefix_errors
from reactorwatch.process import OPERATIONS
from reactorwatch.process.fault import FaultSpecification, parse_fault
from reactorwatch.process.library.cstr_operation import LevelControl, TemperatureControl
from reactorwatch.process.model import Extension, ProcessModel
from reactorwatch.process.operation import Controller, InputLevels
from reactorwatch.runtime.config import MODEL_IS_PROCESS, OlderKeys, check_bounds
from reactorwatch.units import conversion


class PlantConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the simulated plant.

    A settings table may name one of `presets` as `preset`; the table and the flags override the preset's settings.

    Attributes:
        name: name of the plant, in keys and file names.
        period_min: sampling period, in minutes of the plant.
        speed: plant time over wall time; 1: real time, inf: as fast as possible.
        duration_min: length of the run, in minutes of the plant; None: endless.
        seed: seed of the input and all noise.
        zero_ns: plant time 0, in nanoseconds since 1970-01-01 UTC; None: the time of the start.
        process: the process, by name or file, with equations; the minutes of an extended model are those of the plant.
            None: the reactor.
        scenario: the inputs: a kind (random-steps, sines, square, constant) with its defaults, the path of a record, or
            a table with `kind` and its parameters (see `plant_node.scenario`); of several inputs, a table with one of
            these for each. Under control it is used as dither only.
        controllers: controllers by input, with the keys of `Controller`: those of the process with other values, or
            further ones.
        open_loop: true to leave out the controllers of the process.
        temperature_control: the reactor's, see `TemperatureControl`; None: open loop.
        level_control: the reactor's, see `LevelControl`; None: the volume is constant.
        process_noise_sd: process noise by name of a state, in the state's unit per square root of a minute (see
            `plant_node.instruments`), such as {T = 0.2}.
        noise_sd: standard deviation of the measurement noise by signal, in the unit of the equations; without an entry
            that of the process.
        resolution: resolution of the sensor by signal, in the unit of the equations; 0: continuous; without an entry
            that of the process's signal.
        limits: smallest and largest value of each input, at which its actuator saturates; without an entry those of the
            process's signal, or of the equations.
        valve_limits_l_min: older name of `limits`, for the only input of a process.
        faults: faults that are in the plant from the start, such as `coolant_flow:step:-0.05@30min`, in addition to
            those of an extended model.
        start: the steady state at the first inputs or, under control, of the closed loop (of several, `operating`: the
            one with the largest last output, `extinguished`: with the smallest), or a value for each state, such as
            {C = 0.1, T = 438.54}.
        health_period_s: interval at which health is published, in seconds of the wall clock.
        wait_for: nodes that must be alive before the first row, such as `monitor`.
    """

    presets: ClassVar[dict[str, Mapping[str, Any]]] = {
        preset.name: preset.settings for operation in OPERATIONS.values() for preset in operation.presets
    }
    older_keys: ClassVar[OlderKeys] = MODEL_IS_PROCESS

    name: str = DEFAULT_PLANT
    period_min: Annotated[float, msgspec.Meta(ge=1e-4, le=60.0)] = 0.1
    speed: float = 1.0
    duration_min: float | None = None
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] = 0
    zero_ns: int | None = None
    process: str | None = None
    scenario: str | dict[str, Any] = "random-steps"
    controllers: dict[str, dict[str, Any]] = {}  # msgspec copies defaults
    open_loop: bool = False
    temperature_control: TemperatureControl | None = None
    level_control: LevelControl | None = None
    process_noise_sd: dict[str, float] = {}
    noise_sd: dict[str, float] = {}
    resolution: dict[str, float] = {}
    limits: dict[str, tuple[float, float]] = {}
    valve_limits_l_min: tuple[float, float] | None = None
    faults: tuple[str, ...] = ()
    start: Literal["operating", "extinguished"] | dict[str, float] = "operating"
    health_period_s: Annotated[float, msgspec.Meta(ge=0.1, le=3600.0)] = 5.0
    wait_for: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_plant(self.name)
        check_bounds(PlantConfig, msgspec.structs.asdict(self))
        if not self.speed > 0:
            raise ValueError(f"speed must be above 0, or inf for as fast as it goes, got {self.speed:g}")
        if self.duration_min is not None and not (isfinite(self.duration_min) and self.duration_min > 0):
            raise ValueError(f"duration_min must be above 0, or left out for an endless run, got {self.duration_min:g}")
        valve = {} if self.valve_limits_l_min is None else {"valve_limits_l_min": self.valve_limits_l_min}
        for name, (lower, upper) in {**self.limits, **valve}.items():
            if not lower < upper:
                raise ValueError(f"limits of {name} must be two rising numbers, got {lower:g} and {upper:g}")
        for what, per_name in (
            ("noise_sd", self.noise_sd),
            ("resolution", self.resolution),
            ("process_noise_sd", self.process_noise_sd),
        ):
            for name, value in per_name.items():
                if not (isfinite(value) and value >= 0):
                    raise ValueError(f"{what} of {name} must be at least 0, got {value:g}")

    @property
    def rows(self) -> int | None:
        """Number of rows of the run, those before its duration; None: endless."""
        return None if self.duration_min is None else max(round(self.duration_min / self.period_min), 1)


@dataclass(frozen=True)
class ProcessSettings:
    """Settings of the plant as its process has them, in the units of the equations.

    Attributes:
        scenarios: programme of each input, by name.
        controllers: controllers that act once a row, by input.
        equations: the model, with the controllers that act in continuous time.
        faults: faults that are in the plant from the start.
        actuators: actuator of each input, by name.
        sensors: sensor of each signal, by name, those of the inputs first.
    """

    scenarios: Mapping[str, Settings]
    controllers: Mapping[str, Controller]
    equations: ProcessModel
    faults: tuple[FaultSpecification, ...]
    actuators: Mapping[str, Actuator]
    sensors: Mapping[str, Sensor]

    def complete(self, config: PlantConfig) -> PlantConfig:
        """Copy of settings in which what the process decides is written out."""
        return with_changes(
            config,
            noise_sd={name: item.noise_sd for name, item in self.sensors.items()},
            resolution={name: item.resolution for name, item in self.sensors.items()},
            limits={name: (item.lower, item.upper) for name, item in self.actuators.items()},
            valve_limits_l_min=None,
        )


def fit_settings(config: PlantConfig, process: Process) -> ProcessSettings:
    """Complete settings by a process."""
    model = process.require_model()
    with prefix_errors("settings [plant]"):
        controllers, model = _controllers(config, process, model)
        bounds = _bounds(process, model)
        return ProcessSettings(
            _scenarios(config, process, model, bounds),
            controllers,
            model,
            tuple(parse_fault(text, process.faults).with_defaults(0.0, config.duration_min) for text in config.faults),
            _actuators(config, model, bounds),
            _sensors(config, process, model),
        )


def to_model_unit(signal: Signal, model: ProcessModel) -> tuple[float, float]:
    """Scale and offset from the unit of a signal to that of the equations."""
    unit = model.units[signal.name]
    return conversion(signal.unit or unit, unit, f"signal {signal.name!r}")


def _scenarios(
    config: PlantConfig, process: Process, model: ProcessModel, bounds: Mapping[str, tuple[float, float]]
) -> dict[str, Settings]:
    given = split_scenarios(config.scenario, model.input_names)
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
        elif isinstance(item, Extension):
            with prefix_errors("level_control" if item is config.level_control else type(item).__name__, ValueError):
                model = item.extend(model)
        else:
            raise InputError(
                f"process {process.name!r}: a controller must be a Controller, or have extend(model), "
                f"got {type(item).__name__}"
            )
    for name, table in config.controllers.items():
        if name not in model.input_names:
            raise InputError(f"controllers: {describe_unknown('input', name, model.input_names)}")
        known: Mapping[str, Any] = {} if name not in found else msgspec.structs.asdict(found[name])
        with prefix_errors(f"controllers: {name}", ValueError):
            found[name] = msgspec.convert({**known, **table, "input": name}, Controller)
    return found, model


def _bounds(process: Process, model: ProcessModel) -> dict[str, tuple[float, float]]:
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


def _actuators(
    config: PlantConfig, model: ProcessModel, bounds: Mapping[str, tuple[float, float]]
) -> dict[str, Actuator]:
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
    return {name: Actuator(*limits.get(name, own)) for name, own in bounds.items()}


def resolutions(process: Process) -> dict[str, float]:
    """Resolutions of the signals of the equations, in the units of the equations."""
    model = process.require_model()
    return {
        signal.name: abs(to_model_unit(signal, model)[0]) * signal.resolution
        for signal in process.signals
        if signal.resolution is not None and signal.name in model.units
    }


def _sensors(config: PlantConfig, process: Process, model: ProcessModel) -> dict[str, Sensor]:
    for setting, given in (("noise_sd", config.noise_sd), ("resolution", config.resolution)):
        for name in given:
            if name not in model.units:
                raise InputError(f"{setting}: {describe_unknown('signal', name, model.units)}")
    noise_sd, resolution = {**process.operation.noise_sd, **config.noise_sd}, resolutions(process) | config.resolution
    return {name: Sensor(name, noise_sd.get(name, 0.0), resolution.get(name, 0.0), config.seed) for name in model.units}
