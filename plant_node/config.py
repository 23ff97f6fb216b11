"""The plant's settings."""

from math import isfinite
from typing import Annotated, Any, ClassVar, Literal

import msgspec

from plant_node.controllers import LevelControl, TemperatureControl
from plant_node.presets import PRESETS
from plant_node.scenario import RandomSteps, Settings, scenario_settings
from reactorwatch.contract.keys import check_plant
from reactorwatch.process.fault import FaultSpecification, parse_fault
from reactorwatch.runtime.setting_rules import check_bounds


class NoiseSd(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Standard deviation of the measurement noise of each signal, in its unit."""

    C: float = 0.002
    T: float = 0.3
    qc: float = 0.0


class Resolution(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Resolution of the sensor of each signal, in the signal's unit; 0: continuous."""

    C: float = 0.0
    T: float = 0.0
    qc: float = 0.0


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
        scenario: the input: a kind (random-steps, sines, square, constant) with its defaults, the path of a .csv
            record, or a table with `kind` and its parameters (see `plant_node.scenario`). Under temperature control it
            is used as dither only.
        temperature_control: see `TemperatureControl`; None: open loop.
        level_control: see `LevelControl`; None: the volume is constant.
        process_noise_sd: process noise by name of a state, in the state's unit per square root of a minute (see
            `plant_node.disturbances`), such as {T = 0.2}.
        noise_sd: see `NoiseSd`.
        resolution: see `Resolution`.
        valve_limits_l_min: flows of the coolant valve, closed and fully open.
        model: file of an extended model (`diagnose -o`) to simulate; its minutes are those of the plant. None: the
            nominal reactor.
        faults: faults that are in the plant from the start, such as `coolant_flow:step:-0.05@30min`, in addition to
            those of `model`.
        start: the steady state at the first input or, under temperature control, of the closed loop (`operating`: the
            hottest, `extinguished`: the coldest), or a value for each state, such as {C = 0.1, T = 438.54}.
        health_period_s: interval at which health is published, in seconds of the wall clock.
        wait_for: nodes that must be alive before the first row, such as `monitor`.
    """

    presets: ClassVar[dict[str, dict[str, Any]]] = {item.name: item.settings for item in PRESETS}

    name: str = "cstr"
    period_min: Annotated[float, msgspec.Meta(ge=1e-4, le=60.0)] = 0.1
    speed: float = 1.0
    duration_min: float | None = None
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] = 0
    zero_ns: int | None = None
    scenario: str | dict[str, Any] = RandomSteps.kind
    temperature_control: TemperatureControl | None = None
    level_control: LevelControl | None = None
    process_noise_sd: dict[str, float] = {}  # msgspec copies the default
    noise_sd: NoiseSd = NoiseSd()
    resolution: Resolution = Resolution()
    valve_limits_l_min: tuple[float, float] = (0.0, 500.0)
    model: str | None = None
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
        lower, upper = self.valve_limits_l_min
        if not 0 <= lower < upper:
            raise ValueError(f"valve_limits_l_min must be two rising flows of at least 0, got {lower:g} and {upper:g}")
        for what, per_name in (
            ("noise_sd", msgspec.structs.asdict(self.noise_sd)),
            ("resolution", msgspec.structs.asdict(self.resolution)),
            ("process_noise_sd", self.process_noise_sd),
        ):
            for name, value in per_name.items():
                if not (isfinite(value) and value >= 0):
                    raise ValueError(f"{what} of {name} must be at least 0, got {value:g}")
        self.scenario_settings()
        self.fault_specifications()

    def scenario_settings(self) -> Settings:
        """Parse the scenario.

        Raises:
            InputError: an invalid kind or parameter.
        """
        return scenario_settings(self.scenario)

    def fault_specifications(self) -> tuple[FaultSpecification, ...]:
        """Parse the faults; the default onset is 0, and the default end of a ramp is that of the run.

        Raises:
            InputError: an invalid specification.
        """
        return tuple(parse_fault(text).with_defaults(0.0, self.duration_min) for text in self.faults)

    @property
    def rows(self) -> int | None:
        """Number of rows of the run, those before its duration; None: endless."""
        return None if self.duration_min is None else max(round(self.duration_min / self.period_min), 1)
