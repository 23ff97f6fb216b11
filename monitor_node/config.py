"""The monitor's settings."""

from collections.abc import Callable, Mapping
from math import ceil, inf
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, TypeAlias

import msgspec

from reactorwatch.contract.keys import DEFAULT_PLANT, check_plant
from reactorwatch.description.read import find_process
from reactorwatch.records.file_format import ResampleRule, parse_resampling
from reactorwatch.runtime.config import check_bounds
from reactorwatch.spc.charts.base import Setting, SignalSetting
from reactorwatch.spc.charts.catalogue import CHARTS, chart
from reactorwatch.spc.charts.value_chart import ValueChart
from reactorwatch.spc.run_length import check_rule

CHART_SETTINGS = [setting for chart in CHARTS for setting in chart.settings if isinstance(setting, Setting)]
CHART_SIGNALS = [setting for chart in CHARTS for setting in chart.settings if isinstance(setting, SignalSetting)]

if TYPE_CHECKING:
    ChartName: TypeAlias = str
    _OfCharts = msgspec.Struct
else:
    ChartName = Literal[tuple(chart.name for chart in CHARTS)]
    _OfCharts = msgspec.defstruct(
        "_OfCharts",
        [
            (item.key, Annotated[float, msgspec.Meta(ge=item.lower, le=item.upper)], item.default)
            for item in CHART_SETTINGS
        ]
        + [(item.key, tuple[str, ...], ()) for item in CHART_SIGNALS],
        frozen=True,
    )

PriorityName = Literal["low", "medium", "high", "critical"]

ReferenceName = Literal["auto", "equations", "black-box", "arx"]

OLDER_REFERENCES = {"process": "equations"}
"""Older words for references in settings files."""

DEFAULT = find_process()
"""Process that is watched where none is named."""

DEFAULT_TRAINING_ROWS = 1000
"""Training where nothing is stated, of a process that has no duration of its own."""

LEAST_FALSE_ALARMS, LARGEST_FALSE_ALARMS = 1e-3, 1e6
"""Fewest and most false alarms in 30 days that can be asked for."""


class DefaultCharts(tuple[str, ...]):
    """Charts that the settings do not name; the type tells them from the same charts named, in other processes too."""

    __slots__ = ()


USUAL_CHARTS = DefaultCharts(("shewhart", "ewma", "mewma", "level"))
"""Charts where the settings name none."""

CHARTS_OF_MANY = DefaultCharts(("residual_space", "level"))
"""Charts where the settings name none, of many outputs that no equations judge."""

CHARTS_OF_DOZENS = DefaultCharts(("residual_space", "cva_residual", "level"))
"""Charts where the settings name none, of `DOZENS` outputs or more that no equations judge."""

DOZENS = 20
"""Outputs from which on the relations between them are worth a second chart, with half of the false alarms."""

WITHOUT_EQUATIONS = ""
"""Setting `process` of a plant that no equations judge."""

DEFAULT_SIGNALS = {"inputs": DEFAULT.inputs, "outputs": DEFAULT.outputs}
"""Signals of the default process, by key."""

DEFAULT_PRIORITIES: dict[str, PriorityName] = msgspec.convert(DEFAULT.watch.priorities, dict[str, PriorityName])
"""Priorities where none are stated; the same object, so that it is recognised."""


class TrainingLength(NamedTuple):
    """Duration of a training.

    Attributes:
        minutes: duration in minutes of rows, one sampling period a row; None: it is stated in rows.
        rows: duration in rows.
    """

    minutes: float | None
    rows: int = 0

    def count_rows(self, period_min: float) -> int:
        """Number of rows of the training at a sampling period."""
        if self.minutes is None:
            return self.rows
        # a sampling period is rounded to nanoseconds
        return max(1, ceil(self.minutes / period_min - 0.01))


class MonitorConfig(_OfCharts, frozen=True, forbid_unknown_fields=True):
    """Settings of a monitor. The charts of the catalogue have keys of their own beside these: see `chart_settings`.

    Attributes:
        plant: name of the plant.
        inputs: signals that drive the plant; none, one or several.
        outputs: signals that are predicted and monitored.
        setpoints: signals that controllers aim at; an alarm states their recent moves.
        modes: signals that say how the plant is operated, such as a controller in manual: each mode has a baseline of
            its own; one that the training has not seen is watched by the signal checks only. An alarm states unusual
            ones.
        startup_modes: values by mode in which the plant starts up or shuts down; they are watched by the signal checks
            only.
        labels: signals that are carried along, and ignored.
        bounds: lowest and highest value by signal, in the unit in which it is judged; other values are not measured
            values, and an input at a bound is saturated, which an alarm states.
        resolution: smallest step between two values by output; without it, it is learned.
        uncertain: standard deviations of parameters of the equations, by name, in their units; the diagnosis of the
            training adjusts them.
        units: unit by signal, as its process describes it: that of samples which name none, and, without equations,
            the unit in which a signal is judged.
        order: order of the ARX models; None: 3, and where they judge, that of the least error on rows of the training
            that the fit has not seen.
        delay: delay of the inputs in rows, of all or by input; with 1 they act on the next row. None: 1, unless
            residuals of the training show a dead time.
        forgetting: forgetting factor of the adaptive model, in [0.5, 1]; with 1 it forgets nothing.
        training_min: duration of the training, in minutes of rows, one sampling period a row; time without rows does
            not count. None: see `training_length`.
        training_rows: duration of the training in rows, instead of `training_min`.
        diagnose_training: true to diagnose the training, beside the watch, and to judge the plant by the equations with
            the deviations that it had from the start.
        reference: model that predicts the rows: `equations`, the filter of the process's equations (older: `process`);
            `black-box`, a state map learned from the training, for few signals; `arx`, the identified model as fitted
            to the training; `auto`, the first of these that predicts the training about as well as the last (without
            inputs no black box).
        process: process of the plant: a name in the catalogue, or a .toml, .py or extended.json file; None: the
            nominal reactor where its signals are watched; empty: no equations judge.
        charts: charts of the residuals and of the values; where none are named, `residual_space` for 8 outputs or more
            that no equations judge, with `cva_residual` from 20 on, else `shewhart`, `ewma` and `mewma`; beside them
            `level`.
        false_alarms_per_30_days: number of false alarms in 30 days of the plant, over all alarms; None: 1, or 1
            in 8,640 rows if rows are slower than 5 min; the fewest that the charts can keep if that is more.
        smallest_sd: least standard deviation of the residual by output, in its unit; smaller deviations do not matter.
        isolation: true to search the cause of an alarm, if equations judge.
        isolation_rows: number of newest rows in that search.
        raise_count: number of violating points among the last `window` that raises the Shewhart chart's alarm.
        window: number of points in which `raise_count` is counted.
        clear_count: number of normal points in a row that clears an alarm.
        dead_band: a point is normal within (1 - dead_band) of the limit; in [0, 0.9].
        incident_min: minutes of the plant after the last change of an incident in which an alarm still belongs to it.
        longest_shelf_min: longest time for which an alarm may be shelved, in minutes of the plant.
        state_file: file of the monitor's full state, for a restart; None: it is not stored.
        state_every_s: storage interval in seconds; after a change of an alarm the state is stored at once.
        resample: period of the rows that are made of the samples, such as `10 s`, with methods of signals behind it as
            in `--resample`; None: the rows are those of the samples.
        reorder_rows: number of newer rows that may start before an incomplete row is emitted.
        snapshot_min: interval between published models, in minutes of the plant.
        health_period_s: interval between health messages, in seconds.
        silence_periods: number of sampling periods without a row after which the plant's data timeout is raised.
        priorities: priority of the alarms by signal; medium for signals without an entry.
    """

    plant: str = DEFAULT_PLANT
    inputs: tuple[str, ...] = DEFAULT_SIGNALS["inputs"]
    outputs: tuple[str, ...] = DEFAULT_SIGNALS["outputs"]
    setpoints: tuple[str, ...] = ()
    modes: tuple[str, ...] = ()
    startup_modes: dict[str, tuple[float, ...]] = msgspec.field(default_factory=dict)
    labels: tuple[str, ...] = ()
    bounds: dict[str, tuple[float, float]] = msgspec.field(default_factory=dict)
    resolution: dict[str, float] = msgspec.field(default_factory=dict)
    uncertain: dict[str, float] = msgspec.field(default_factory=dict)
    units: dict[str, str] = msgspec.field(default_factory=dict)
    order: Annotated[int, msgspec.Meta(ge=1, le=20)] | None = None
    delay: Annotated[int, msgspec.Meta(ge=1, le=100)] | dict[str, int] | None = None
    forgetting: Annotated[float, msgspec.Meta(ge=0.5, le=1.0)] = 0.999
    training_min: Annotated[float, msgspec.Meta(ge=1e-3, le=1e6)] | None = None
    training_rows: Annotated[int, msgspec.Meta(ge=1, le=10_000)] | None = None
    diagnose_training: bool = True
    reference: ReferenceName | Literal["process"] = "auto"
    process: str | None = None
    charts: tuple[ChartName, ...] = USUAL_CHARTS
    false_alarms_per_30_days: Annotated[float, msgspec.Meta(ge=LEAST_FALSE_ALARMS, le=LARGEST_FALSE_ALARMS)] | None = (
        None
    )
    smallest_sd: dict[str, float] = msgspec.field(default_factory=lambda: dict(DEFAULT.watch.smallest_sd))
    isolation: bool = True
    isolation_rows: Annotated[int, msgspec.Meta(ge=50, le=10_000)] = 600
    raise_count: int = 3
    window: int = 5
    clear_count: int = 20
    dead_band: Annotated[float, msgspec.Meta(ge=0.0, le=0.9)] = 0.1
    incident_min: Annotated[float, msgspec.Meta(ge=0.0, le=1e6)] = 60.0
    longest_shelf_min: Annotated[float, msgspec.Meta(ge=1e-3, le=1e6)] = 480.0
    state_file: str | None = None
    state_every_s: Annotated[float, msgspec.Meta(ge=0.1, le=3600.0)] = 5.0
    resample: str | None = None
    reorder_rows: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 8
    silence_periods: Annotated[float, msgspec.Meta(ge=1.5, le=1e6)] = 5.0
    snapshot_min: Annotated[float, msgspec.Meta(ge=1e-3, le=1e6)] = 5.0
    health_period_s: Annotated[float, msgspec.Meta(ge=0.05, le=3600.0)] = 5.0
    priorities: dict[str, PriorityName] = msgspec.field(default_factory=lambda: DEFAULT_PRIORITIES)

    older_keys: ClassVar[Mapping[str, tuple[str, Callable[[Any], Any]]]] = MappingProxyType(
        {
            "input": ("inputs", lambda name: [name]),
            "model": ("process", lambda name: name),
            "alarm_state_file": ("", str),  # the state has the alarms
        }
    )
    """Older names of keys, each with the present one and the function from a value of the older to one of it; a key
    without a present one has no effect."""

    def __post_init__(self) -> None:
        check_plant(self.plant)
        check_rule(self.raise_count, self.window, self.clear_count)
        every = (*self.signals, *self.carried_signals, *self.labels)
        if not self.outputs or len(set(every)) != len(every):
            beside = (
                f", and {', '.join(every[len(self.signals) :])} beside them" if len(every) > len(self.signals) else ""
            )
            raise ValueError(
                f"outputs must be at least one signal, and each signal have one role, "
                f"got inputs {self.inputs} and outputs {self.outputs}{beside}"
            )
        self.resample_rule  # noqa: B018 # checks it
        check_bounds(MonitorConfig, msgspec.structs.asdict(self))
        msgspec.structs.force_setattr(self, "reference", OLDER_REFERENCES.get(self.reference, self.reference))
        if self.training_min is not None and self.training_rows is not None:
            raise ValueError(
                f"training_min and training_rows both state the training, got {self.training_min:g} and "
                f"{self.training_rows}; leave one out"
            )
        if isinstance(self.charts, DefaultCharts):
            count = 0 if self._may_have_equations else len(self.outputs)
            many = count >= ValueChart.fewest_signals
            usual = CHARTS_OF_DOZENS if count >= DOZENS else CHARTS_OF_MANY if many else USUAL_CHARTS
            msgspec.structs.force_setattr(self, "charts", usual)
        if len(set(self.charts)) != len(self.charts) or not self.charts:
            raise ValueError(f"charts must be at least one chart, each once, got {self.charts}")
        if self.process is not None and self.outputs == DEFAULT_SIGNALS["outputs"]:
            return  # the outputs are those of the process, which `watched_process` sets
        self._check_chart_signals()
        for signal in () if self.resample_rule is None else self.resample_rule.methods:
            if signal not in self.signals:
                raise ValueError(f"resample has methods of inputs and outputs, {self.signals}, got {signal!r}")
        for signal in self.startup_modes:
            if signal not in self.modes:
                raise ValueError(f"startup_modes are by mode, {self.modes}, got {signal!r}")
        for signal, (lower, upper) in self.bounds.items():
            if signal not in self.signals:
                raise ValueError(
                    f"bounds are by input and output, {self.signals}, got {signal!r}; name the plant's process, or its "
                    "inputs and outputs"
                )
            if not lower < upper:
                raise ValueError(f"bounds of {signal} must be a lower and a higher number, got {lower:g} and {upper:g}")
        for parameter, sd in self.uncertain.items():
            if not 0.0 < sd < inf:
                raise ValueError(f"uncertain: the standard deviation of {parameter} must be positive, got {sd:g}")
        if isinstance(self.delay, dict) and (
            set(self.delay) != set(self.inputs) or not all(1 <= rows <= 100 for rows in self.delay.values())
        ):
            raise ValueError(f"delay must be 1 to 100 rows of each input, {self.inputs}, got {self.delay}")
        for signal, step in self.resolution.items():
            if signal not in self.outputs:
                raise ValueError(f"resolution is by output, {self.outputs}, got {signal!r}")
            if not 0 < step < 1e6:
                raise ValueError(f"resolution of {signal} must be in (0, 1e6), got {step:g}")
        for signal, sd in self.smallest_sd.items():
            if signal not in (*self.outputs, *DEFAULT.watch.smallest_sd):
                raise ValueError(f"smallest_sd is by output, {self.outputs}, got {signal!r}")
            if not 0 <= sd < 1e6:
                raise ValueError(f"smallest_sd of {signal} must be in [0, 1e6), got {sd:g}")
        if self.priorities is DEFAULT_PRIORITIES:
            held = {signal: priority for signal, priority in DEFAULT_PRIORITIES.items() if signal in self.outputs}
            msgspec.structs.force_setattr(self, "priorities", held)
        for signal in self.priorities:
            if signal not in self.outputs:
                raise ValueError(f"priorities are by output, {self.outputs}, got {signal!r}")

    @property
    def resample_rule(self) -> ResampleRule | None:
        """Period and methods of the rows that are made of the samples; None: none are made."""
        if self.resample is None:
            return None
        rule = parse_resampling(self.resample, "resample")
        if rule.period_s is None:
            raise ValueError(f"resample must state a period, such as 10 s, got {self.resample!r}")
        return rule

    @property
    def training_length(self) -> TrainingLength:
        """Duration of the training: as stated, else that of the default process and 1,000 rows of another one."""
        if self.training_rows is not None:
            return TrainingLength(None, self.training_rows)
        minutes = DEFAULT.watch.training_min if self.is_default_process else None
        if self.training_min is None and minutes is None:
            return TrainingLength(None, DEFAULT_TRAINING_ROWS)
        return TrainingLength(minutes if self.training_min is None else self.training_min)

    @property
    def _may_have_equations(self) -> bool:
        if self.reference in ("black-box", "arx") or self.process == WITHOUT_EQUATIONS:
            return False
        return self.process is not None or self.is_default_process

    @property
    def is_default_process(self) -> bool:
        """True if the signals are those of the default process."""
        return self.inputs == DEFAULT_SIGNALS["inputs"] and set(self.outputs) <= set(DEFAULT_SIGNALS["outputs"])

    @property
    def signals(self) -> tuple[str, ...]:
        """Signals of a row: the inputs, then the outputs."""
        return (*self.inputs, *self.outputs)

    @property
    def carried_signals(self) -> tuple[str, ...]:
        """Signals beside the rows that go with an alarm: set points, then modes."""
        return (*self.setpoints, *self.modes)

    @property
    def has_values_only(self) -> bool:
        """True if all charts of the settings are of values, so that there may be none after a training."""
        return all(issubclass(chart(name), ValueChart) for name in self.charts)

    @property
    def chart_settings(self) -> dict[str, float]:
        """The charts' own settings, by key."""
        return {setting.key: getattr(self, setting.key) for setting in CHART_SETTINGS}

    @property
    def chart_signals(self) -> dict[str, tuple[str, ...]]:
        """Signals that the settings name for charts, by key."""
        return {setting.key: getattr(self, setting.key) for setting in CHART_SIGNALS}

    def _check_chart_signals(self) -> None:
        for item in CHART_SIGNALS:
            names, kinds = (
                self.chart_signals[item.key],
                [kind for kind in map(chart, self.charts) if item in kind.settings],
            )
            if not names and kinds:
                raise ValueError(
                    f"the chart {kinds[0].name} needs {item.key}, got none; name at most {item.most} of {self.signals}"
                )
            unknown = [name for name in names if name not in self.signals]
            if unknown or len(set(names)) != len(names) or len(names) > item.most:
                raise ValueError(f"{item.key} must be at most {item.most} of {self.signals}, each once, got {names}")
