"""The kinds of model that can be compared: anything that can be fitted, predict the next row, and run freely."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.identification.batch import fit_arx
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.output_error import fit_oe
from reactorwatch.identification.structure import Structure


class Model(Protocol):
    """A fitted model. Signals are arrays of shape (rows,) or (rows, signals), NaN where nothing was measured."""

    @property
    def parameter_count(self) -> int:
        """Number of parameters."""

    def one_step(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """Each row from the measured rows before it, shape (rows, outputs); NaN where they are not complete."""

    def free_run(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """The model on its own outputs, shape (rows, outputs); NaN in the rows that it starts from."""

    def residuals(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """Measured minus predicted, by the prediction that the model was fitted for, shape (rows, outputs)."""


class Family(Protocol):
    """A kind of model."""

    @property
    def name(self) -> str:
        """What people call it."""

    def fit(self, structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Model:
        """The model of a structure that explains a record best.

        Raises:
            InputError: a record that does not determine the model.
        """


@dataclass(frozen=True)
class Arx:
    """Linear, fitted to predict the next row."""

    name: str = "arx"

    def fit(
        self, structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None
    ) -> LinearModel:
        """See `fit_arx`."""
        return fit_arx(structure, inputs, outputs, time)


@dataclass(frozen=True)
class OutputError:
    """Linear, fitted to run freely."""

    name: str = "oe"

    def fit(
        self, structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None
    ) -> LinearModel:
        """See `fit_oe`."""
        return fit_oe(structure, inputs, outputs, time)


LINEAR_FAMILIES: tuple[Family, ...] = (Arx(), OutputError())
