"""Model families for comparison: anything that can be fitted, predict and simulate."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

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

    def predict(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """One-step-ahead prediction, shape (rows, outputs); NaN where the rows before are incomplete."""

    def simulate(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """Simulation, shape (rows, outputs); NaN in the rows that it starts from."""

    def residuals(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> NDArray[np.float64]:
        """Measured minus predicted or simulated, as in the fit, shape (rows, outputs)."""


class Family(Protocol):
    """A model family."""

    @property
    def name(self) -> str:
        """Name of the family."""

    def fit(self, structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Model:
        """Fit a model of a structure to a record.

        Raises:
            InputError: the record does not determine the model.
        """


class LinearFamily(NamedTuple):
    """Linear models by their fit, see `Family`."""

    name: str
    fit: Callable[..., LinearModel]


LINEAR_FAMILIES: tuple[Family, ...] = (LinearFamily("arx", fit_arx), LinearFamily("oe", fit_oe))
