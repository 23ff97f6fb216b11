"""Recursive least squares of thousands of plants, updated in one call: `rls.py` with the plants as the inner loop."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.identification import information
from reactorwatch.identification.information import TILE_PLANTS
from reactorwatch.identification.recursion import Recursion, RlsState, describe_invalid
from reactorwatch.identification.rls import RecursiveLeastSquares


class RlsUpdates(NamedTuple):
    """Fields of `RlsUpdate` for one row of every plant, each of shape (plants,); NaN for an absent plant."""

    prediction: NDArray[np.float64]
    residual: NDArray[np.float64]
    residual_sd: NDArray[np.float64]
    leverage: NDArray[np.float64]


class RecursiveLeastSquaresBank(Recursion):
    """`RecursiveLeastSquares` of many plants, each with parameters of its own, updated in one call.

    A plant's numbers are those of the single form, bit for bit.

    Args:
        plants: number of plants.
        parameters: number of parameters of each, n.
        forgetting: see the single form.
        covariance_limit: see the single form.

    Raises:
        InputError: a setting out of its range.
    """

    def __init__(
        self, plants: int, parameters: int, forgetting: float = 1.0, covariance_limit: float | None = None
    ) -> None:
        super().__init__(plants, parameters, forgetting, covariance_limit, plants_in_tile=TILE_PLANTS)

    @classmethod
    def from_state(cls, state: RlsState) -> Self:
        """Resume, bit for bit from a state.

        Raises:
            ValueError: the state is damaged.
        """
        bank = cls(state.plants, state.parameters, state.forgetting, state.covariance_limit)
        bank._load(state.memory)
        return bank

    def update(self, regressors: ArrayLike, outputs: ArrayLike, present: NDArray[np.bool_] | None = None) -> RlsUpdates:
        """Predict every plant's output, then learn from it.

        Args:
            regressors: shape (plants, n).
            outputs: shape (plants,).
            present: shape (plants,); False leaves a plant as it is and its row unread. All, if not given.

        Raises:
            ValueError: a present row with a value that is NaN, infinite or beyond 1e30, or a wrong shape; nothing
                is changed then, in no plant.
        """
        rows = np.ascontiguousarray(regressors, dtype=np.float64)
        measured = np.ascontiguousarray(outputs, dtype=np.float64)
        if rows.shape != (self._plants, self._parameters) or measured.shape != (self._plants,):
            raise ValueError(
                f"regressors and outputs must have the shapes {(self._plants, self._parameters)} and "
                f"{(self._plants,)}, got {rows.shape} and {measured.shape}"
            )
        if present is None:
            present = np.ones(self._plants, dtype=np.bool_)
        if present.shape != (self._plants,) or present.dtype != np.bool_:
            raise ValueError(f"present must be {self._plants} booleans, got {present.shape} of {present.dtype}")
        refused = information.first_invalid(rows, measured, present)
        if refused >= 0:
            raise ValueError(f"plant {refused}: {describe_invalid(rows[refused], measured[refused])}")
        results = np.empty((4, self._plants))
        information.learn_all(
            self._tiles, rows, measured, present, self._forgetting, self._renewal, self._rank_share, results
        )
        return RlsUpdates(*results)

    def plant(self, index: int) -> RecursiveLeastSquares:
        """A copy of one plant's estimator, in the single form.

        Raises:
            IndexError: there is no such plant.
        """
        if not 0 <= index < self._plants:
            raise IndexError(f"plant must be in 0..{self._plants - 1}, got {index}")
        size = information.state_size(self._parameters)
        memory = self._tiles[index // TILE_PLANTS, :size, index % TILE_PLANTS].astype("<f8").tobytes()
        return RecursiveLeastSquares.from_state(
            RlsState(1, self._parameters, self._forgetting, self._covariance_limit, memory)
        )

    @property
    def parameters(self) -> NDArray[np.float64]:
        """Shape (plants, n)."""
        theta = self._tiles[:, : self._parameters].transpose(0, 2, 1).reshape(-1, self._parameters)
        return theta[: self._plants].copy()
