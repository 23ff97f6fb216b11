"""The plant's settings."""

from collections.abc import Callable, Mapping
from math import isfinite
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal

import msgspec

from reactorwatch.contract.keys import DEFAULT_PLANT, check_plant
from reactorwatch.process import OPERATIONS
from reactorwatch.process.library.cstr.controllers import LevelControl, TemperatureControl
from reactorwatch.runtime.setting_rules import check_bounds


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
            `plant_node.disturbances`), such as {T = 0.2}.
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
    older_keys: ClassVar[Mapping[str, tuple[str, Callable[[Any], Any]]]] = MappingProxyType(
        {"model": ("process", lambda name: name)}
    )
    """Older names of keys, each with the present one and the function from a value of the older to one of it."""

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
