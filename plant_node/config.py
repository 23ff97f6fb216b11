"""The plant's settings."""

from math import isfinite
from typing import Any, ClassVar, Literal

import msgspec

from plant_node.controllers import LevelControl, TemperatureControl
from plant_node.presets import PRESETS
from plant_node.scenario import RandomSteps, Settings, scenario_settings
from reactorwatch.contract.keys import check_plant
from reactorwatch.process.fault import FaultSpecification, parse_fault


class NoiseSd(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Standard deviation of the measurement noise of each signal, in its unit."""

    C: float = 0.002
    T: float = 0.3
    qc: float = 0.0


class Resolution(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The smallest difference that the sensor of each signal can show, in the signal's unit; 0: any."""

    C: float = 0.0
    T: float = 0.0
    qc: float = 0.0


class PlantConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a plant is simulated.

    A settings table may name one of `presets` as `preset`: its settings hold where the table and the flags say nothing.

    Attributes:
        name: of the plant, in keys and file names.
        period_min: between two rows, in minutes of the plant.
        speed: plant time over wall time; 1: real time, inf: as fast as it goes.
        duration_min: of the run, in minutes of the plant; None: endless.
        seed: of the input and all noise.
        zero_ns: plant time 0, in nanoseconds since 1970-01-01 UTC; None: when it starts.
        scenario: the input: a kind (random-steps, sines, square, constant) for its defaults, the path of a .csv
            record, or a table with `kind` and its numbers (see `plant_node.scenario`). Not used under temperature
            control, unless as its dither.
        temperature_control: see `TemperatureControl`; None: open loop.
        level_control: see `LevelControl`; None: the volume is constant.
        process_noise_sd: of the states by name, in the state's unit per square root of a minute (see
            `plant_node.disturbances`), such as {T = 0.2}.
        noise_sd: see `NoiseSd`.
        resolution: see `Resolution`.
        valve_limits_l_min: what the coolant valve lets through, closed and fully open.
        model: file of an extended model (`diagnose -o`) that the plant is; its minutes are those of the plant. None:
            the nominal reactor.
        faults: that are in it from the start, such as `coolant_flow:step:-0.05@30min`; on top of those of `model`.
        start: the steady state at the first input or, under temperature control, of the closed loop (`operating`: the
            hottest, `extinguished`: the coldest), or a value for each state, such as {C = 0.1, T = 438.54}.
        health_period_s: how often health is published, in seconds of the wall clock.
        wait_for: nodes that must be alive before the first row, such as `monitor`.
    """

    presets: ClassVar[dict[str, dict[str, Any]]] = {item.name: item.settings for item in PRESETS}

    name: str = "cstr"
    period_min: float = 0.1
    speed: float = 1.0
    duration_min: float | None = None
    seed: int = 0
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
    health_period_s: float = 5.0
    wait_for: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_plant(self.name)
        for what, value, low, high in (
            ("period_min", self.period_min, 1e-4, 60.0),
            ("health_period_s", self.health_period_s, 0.1, 3600.0),
            ("seed", self.seed, 0, 2**63 - 1),
        ):
            if not low <= value <= high:
                raise ValueError(f"{what} must be in [{low:g}, {high:g}], got {value:g}")
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
        """The scenario.

        Raises:
            InputError: a kind or a number that cannot be.
        """
        return scenario_settings(self.scenario)

    def fault_specifications(self) -> tuple[FaultSpecification, ...]:
        """The faults, every number said: an onset that was left out is 0, a ramp ends with the run.

        Raises:
            InputError: a specification that cannot be.
        """
        return tuple(parse_fault(text).settled(0.0, self.duration_min) for text in self.faults)

    @property
    def rows(self) -> int | None:
        """How many rows the run has: those at 0, one period, two ... before its duration; None: endless."""
        return None if self.duration_min is None else max(round(self.duration_min / self.period_min), 1)
