"""References: models that predict the rows of a plant; residuals are taken against the predictions.

There are three: the extended Kalman filter of a process model (`process_reference`), a black box of few signals
(`black_box_reference`), and the identified models, recursive ARX models (`arx`).
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

from monitor_node.ingest.alignment import MeasuredRow
from monitor_node.learn.training_rows import RowArrays
from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.contract.messages_pb2 import ModelSnapshot
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process.model import ProcessModel

COPY_ROWS = 250
"""Rows between two copies of a model that learns: the end of learning takes back at least so many rows."""


class RowPrediction(NamedTuple):
    """One-step-ahead prediction of a row.

    Attributes:
        prediction: predicted outputs in their units; NaN where there is none.
        sd: standard deviations of the residuals in the same units; 1 if unknown.
        extrapolation: for tests that need every row, predictions with their standard deviations that include those
            where the reference knows too little of the point of operation for charts; None: they are the same.
        memory_share: share of a residual that charts with a memory take, at most 1: what is not known of the plant at a
            point of operation lasts, and they would add it up.
    """

    prediction: Sequence[float]
    sd: Sequence[float]
    extrapolation: tuple[Sequence[float], Sequence[float]] | None = None
    memory_share: float = 1.0


class RowFilter(NamedTuple):
    """A reference's filter of a row as machine code, for the compiled step of ordinary rows.

    Attributes:
        code: machine code of the filter; None: `black_box_filter.filter_row`.
        parameters: parameters of the equations; none for a black box, whose constants are those of a plant.
        sizes: sizes of the two arrays of `FilterReference.numbers`.
        spacing_min: shortest and longest time between two rows, in minutes.
    """

    code: CompiledFunction | None
    parameters: Array
    sizes: tuple[int, int]
    spacing_min: tuple[float, float]


class PlantEquations(NamedTuple):
    """Equations of a plant, with the noise of a filter of the equations alone.

    Attributes:
        equations: the process model.
        plant_noise: noise of the plant and its sensors.
    """

    equations: ProcessModel
    plant_noise: NoiseLevels


class Reference(ABC):
    """Predicts rows.

    Attributes:
        kind: `equations`, `black-box` or `arx`, as published.
        is_identified: True if the identified models predict, which are then not updated beside it.
        obstacles: reasons why rows are not judged now, each with what it is about.
        has_returned: True if the newest row ended a fault, and the reference goes on as if it had not followed it.
    """

    kind: ClassVar[str]
    is_identified: ClassVar[bool] = False
    obstacles: Mapping[str, str] = MappingProxyType({})
    has_returned: bool = False

    @property
    @abstractmethod
    def memory(self) -> Any:
        """The memory, without equations and models; its `reference` makes one that resumes from a copy of it."""

    @property
    @abstractmethod
    def typical_sd(self) -> list[float]:
        """Median standard deviation of each residual, in the outputs' units; 1 if unknown."""

    @property
    def filter(self) -> "FilterReference | None":
        """The reference itself, if it is a filter whose rows the compiled step can take."""
        return None

    # --- rows ------------------------------------------------------------------------------------------------

    @abstractmethod
    def update(self, row: MeasuredRow, accept: tuple[bool, ...]) -> RowPrediction:
        """Predict a row, then update with it; an accepted output corrects the reference whatever its residual."""

    @abstractmethod
    def restart(self) -> None:
        """Restart with the next row: the plant's clock was set, or there was a gap."""

    def set_learning(self, learning: bool) -> None:  # noqa: B027 # without memory of the plant there is nothing to do
        """Learn from the rows to come, or not: while nothing is wrong, or a fault would be learned as ordinary."""

    @property
    def is_away(self) -> bool:
        """True if the newest row is not what the reference predicts without the rows since before the alarm."""
        return False

    @property
    def errs(self) -> bool:
        """True if the residuals of held-out blocks are errors of the model: limits then follow from their peaks."""
        return False

    @property
    def weakness(self) -> str:
        """Reason why the promise may not hold at set points that the training has not seen; empty if it does."""
        return ""

    # --- what is known of the plant --------------------------------------------------------------------------

    @property
    def plant(self) -> PlantEquations | None:
        """Equations of the plant; None if it is not judged by equations."""
        return None

    @property
    def follows_equations(self) -> bool:
        """True if the plant is judged by equations."""
        return self.plant is not None

    @property
    def known_plant(self) -> PlantEquations | None:
        """Equations with the disturbances, and noise, as if the constants were known; None without equations."""
        return None

    @property
    def noise_levels(self) -> dict[str, dict[str, float]] | None:
        """Standard deviations of the sensors and the states by name; None without equations."""
        return None

    def snapshot(self, output: int, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> ModelSnapshot | None:
        """Snapshot of the model of an output; None if the reference has no model of its own for it."""
        return None

    def step_responses(self, rows: int) -> Array | None:
        """Response of each normalised residual to a lasting step of one unit of its output, shape (outputs, rows).

        NaN where there is no model; None with equations.
        """
        return None

    def normalised_residuals(self, rows: RowArrays) -> Array | None:
        """Normalised residuals of other rows, shape (n, outputs); None: `step_responses` states them for a bias."""
        return None


class FilterReference(Reference):
    """Reference by a filter, whose ordinary rows the compiled step takes."""

    @property
    def typical_sd(self) -> list[float]:
        """See `Reference`."""
        sds: list[float] = self.memory.typical_sd
        return sds

    @property
    def filter(self) -> "FilterReference":
        """See `Reference`."""
        return self

    @property
    def last_inputs(self) -> tuple[float, ...]:
        """The newest value of each input that was not missing."""
        inputs: tuple[float, ...] = self.memory.last_inputs
        return inputs

    @abstractmethod
    def row_filter(self, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> RowFilter | None:
        """The filter as machine code; None if the compiled step cannot take the rows of such signals."""

    @property
    @abstractmethod
    def numbers(self) -> tuple[Array, Array]:
        """Belief of the filter and its constants: its own numbers, which the compiled step updates."""

    @abstractmethod
    def is_ordinary(self, time_min: float) -> bool:
        """True if the compiled step may take the row after the one of this time."""

    @abstractmethod
    def accept_row(self, time_min: float, inputs: tuple[float, ...]) -> None:
        """Note a row that the compiled step has filtered in `numbers`."""
