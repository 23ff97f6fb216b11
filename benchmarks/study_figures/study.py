"""Common parts of the figures: entries and their findings, the drawing, the model, the records and the fitted models.

The same drawing gives the same bytes. Colours are those of Okabe & Ito (2008), Color Universal Design. All records are
simulated by this software, each with the seed of the study; what is asked for twice is made once.
"""

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Drawing
from PIL import Image

from benchmarks.study_figures import report_scheme
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from plant_node.scenario import Scenario
from reactorwatch.arrays import Array
from reactorwatch.figures import DPI, figure_png, plain_style
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.selection import LINEAR_FITS, Model
from reactorwatch.identification.structure import Structure
from reactorwatch.process.library.cstr import OPERATING_COOLANT_FLOW, cstr
from reactorwatch.process.library.cstr_operation import NOISE_SD, OPERATION
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from reactorwatch.process.steady_state import SteadyState, steady_states
from reactorwatch.records.record import Record
from reactorwatch.records.write import atomic_write


class Verdict(Enum):
    """Agreement of a finding with the report."""

    AGREES = "confirmed"
    IN_PART = "confirmed in part"
    DISAGREES = "corrected"
    NO_CLAIM = "the report states no result"


@dataclass(frozen=True)
class Finding:
    """Finding of a figure."""

    text: str  # Markdown, with the numbers of this run
    verdict: Verdict = Verdict.NO_CLAIM  # agreement with the report


@dataclass(frozen=True)
class Figure:
    """One figure of the report, or one of its sections that has a claim and no figure."""

    key: str  # number of the report's caption, such as `8`; `section-` and a word for a section
    title: str  # subject of the figure
    claim: str  # statement of the report, in our words
    draw: Callable[["Study", Drawing], Finding]  # function that puts it on an empty drawing and returns the finding
    height_px: int = 500  # height of the picture, which is 900 px wide

    @property
    def heading(self) -> str:
        """Heading of its entry."""
        if self.key.startswith("section-"):
            return self.title
        return f"{'Figures' if '-' in self.key else 'Figure'} {self.key.replace('-', ' to ')}: {self.title}"

    @property
    def file_name(self) -> str:
        """File name of the picture."""
        return f"{self.key}.png" if self.key.startswith("section-") else f"figure-{self.key.zfill(2)}.png"


def verdict(agrees: bool) -> Verdict:
    """Verdict on a claim that is right or wrong as a whole."""
    return Verdict.AGREES if agrees else Verdict.DISAGREES


BLACK, GREY = "#000000", "#8c8c8c"
BLUE, ORANGE, GREEN, VERMILION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE = "#56B4E9", "#CC79A7"

WIDTH_PX = 900
_PALETTE = 256  # colours in a file: a third of the bytes


@contextmanager
def paper(path: Path, height_px: int) -> Iterator[Drawing]:
    """An empty drawing, which is written to `path` (PNG) when the block ends without an error."""
    with plain_style():
        drawing = Drawing(figsize=(WIDTH_PX / DPI, height_px / DPI), dpi=DPI, layout="constrained")
        FigureCanvasAgg(drawing)
        yield drawing
        pixels = figure_png(drawing)
    picture = (
        Image.open(io.BytesIO(pixels))
        .convert("RGB")
        .quantize(_PALETTE, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    )
    with atomic_write(path) as temporary:
        picture.save(temporary, format="PNG", optimize=True)


def panels(drawing: Drawing, rows: int, columns: int, **options: Any) -> list[Axes]:
    """Axes in a grid, row by row."""
    return list(drawing.subplots(rows, columns, squeeze=False, **options).ravel())


def label(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Name what is on the axes; an empty name is left out."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    if title:
        axes.set_title(title)


def legend_below(drawing: Drawing, axes: Axes, columns: int, extra: Sequence[Any] = ()) -> None:
    """One legend for the whole drawing, under it."""
    handles, _ = axes.get_legend_handles_labels()
    drawing.legend(handles=[*handles, *extra], loc="outside lower center", ncols=columns)


ORDERS = (1, 2, 3)
OUTPUTS = ("C", "T")
NAMES = {"C": "C, mol/l", "T": "T, K", "qc": "qc, l/min"}
TRAINING_ROWS = 1000
"""Fault-free rows at the start of the fault records: 100 minutes."""

_NO_NOISE = {"C": 0.0, "T": 0.0}
IDENTIFICATION_HOLD_MIN, FAST_HOLD_MIN = 1.0, 2.4
_IDENTIFICATION = {"kind": "random-steps", "low": 85.0, "high": 111.0, "hold_min": IDENTIFICATION_HOLD_MIN}
_FAST = {"kind": "random-steps", "low": 90.0, "high": 108.0, "hold_min": FAST_HOLD_MIN}
_ROWS = 4000
_FAST_ROWS = 48_000
FAST_PERIOD_MIN = 0.01


class Study:
    """Model, records and fits of one run of `reproduce`."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    @cached_property
    def model(self) -> ProcessModel:
        """The reactor."""
        return cstr()

    @cached_property
    def simulator(self) -> Simulator:
        """Simulator of the reactor."""
        return Simulator(self.model)

    @cache  # noqa: B019 # a study lives as long as its process
    def points(self, qc: float) -> list[SteadyState]:
        """The steady states at a coolant flow in l/min, from the coldest to the hottest."""
        return steady_states(self.model, np.array([qc]))

    def operating(self, qc: float = OPERATING_COOLANT_FLOW) -> SteadyState:
        """The steady state on the operating branch."""
        return self.points(qc)[-1]

    @cached_property
    def identification(self) -> Record:
        """Record for identification: with the sensors' noise, 0.1 min between rows."""
        return simulate_record(PlantConfig(seed=self.seed, scenario=_IDENTIFICATION), _ROWS)

    @cached_property
    def noise_free(self) -> Record:
        """The simulated record of `identification` without noise."""
        return self.quiet(_IDENTIFICATION)

    @cached_property
    def small_steps(self) -> Record:
        """Record without noise, so close to 100 l/min that the plant is nearly linear."""
        return self.quiet({"kind": "random-steps", "low": 99.9, "high": 100.1, "hold_min": 1.0})

    def quiet(self, scenario: dict[str, Any]) -> Record:
        """A record without noise, 0.1 min between rows, of a scenario as settings have it."""
        return simulate_record(PlantConfig(seed=self.seed, scenario=scenario, noise_sd=_NO_NOISE), _ROWS)

    def fast(self, noise: bool) -> Record:
        """A record of 0.01 min between rows, in which every level is held for `FAST_HOLD_MIN`."""
        config = PlantConfig(seed=self.seed, period_min=FAST_PERIOD_MIN, scenario=_FAST)
        return simulate_record(config if noise else msgspec.structs.replace(config, noise_sd=_NO_NOISE), _FAST_ROWS)

    @property
    def source(self) -> str:
        """Description of the identification record of figures 5, 6 and 11 to 16."""
        record = self.identification
        period = float(np.median(np.diff(record.time_min)))
        low, high, noise = _IDENTIFICATION["low"], _IDENTIFICATION["high"], NOISE_SD
        return (
            f"{record.rows} simulated rows {period:g} min apart, a new coolant flow between {low:g} and {high:g} "
            f"l/min every {IDENTIFICATION_HOLD_MIN:g} min, noise of {noise['C']:g} mol/l and {noise['T']:g} K "
            "(standard deviations)"
        )

    def signals(self, output: str) -> tuple[Array, Array, Array]:
        """Input, output and time of the identification record."""
        record = self.identification
        return record.columns["qc"], record.columns[output], record.time_min

    @cache  # noqa: B019 # as `points`
    def fit(self, family: str, order: int, output: str) -> Model:
        """Fit a model to the first half of the identification record."""
        half = (values[: values.size // 2] for values in self.signals(output))
        return LINEAR_FITS[family](Structure.of_order(order), *half)

    @cache  # noqa: B019 # as `points`
    def report_fit(self, family: str, order: int, output: str) -> LinearModel:
        """Fit a model to the first half of the identification record by the report's scheme; `arx` or `oe`."""
        half = (values[: values.size // 2] for values in self.signals(output))
        return report_scheme.MODELS[family](Structure.of_order(order), *half)

    def spread(self, signal: str) -> float:
        """Standard deviation of a signal over the first half of the identification record, in its unit."""
        values = self.identification.columns[signal]
        return float(np.nanstd(values[: values.size // 2]))

    @cache  # noqa: B019 # as `points`
    def fault_record(self, preset: str) -> Record:
        """One of the four named records."""
        (settings,) = (item.settings for item in OPERATION.presets if item.name == preset)
        return simulate_record(msgspec.convert({"seed": self.seed, **settings}, PlantConfig))


def row_times(rows: int, period_min: float) -> Array:
    """Minutes from 0, shape (rows,)."""
    return np.arange(rows, dtype=np.float64) * period_min


def levels(scenario: Scenario, time_min: Array, seed: int) -> Array:
    """The coolant flow of a scenario at some times, shape (rows,)."""
    return np.array([scenario.level(float(t), seed) for t in time_min])


def edge(holds: Callable[[float], bool], low: float, high: float, precision: float = 1e-3) -> float:
    """Edge of a condition that holds at `low` and not at `high`, by bisection."""
    while high - low > precision:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return 0.5 * (low + high)


def holdout_half(values: Array) -> Array:
    """The half of a record that no model is fitted to."""
    return values[values.size // 2 :]
