"""Settings and state of recursive least squares, for one plant and for thousands."""

import math

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.identification import information
from reactorwatch.identification.information import LARGEST_VALUE
from reactorwatch.stored_state import StoredState

DEFAULT_COVARIANCE_LIMIT = 1e6


class RlsState(StoredState, frozen=True):
    """State of a recursive estimator.

    Attributes:
        plants: number of plants.
        parameters: number of parameters of each.
        forgetting: weight of a row relative to its successor.
        covariance_limit: bound on the eigenvalues of P.
        memory: little-endian doubles, shape (plants, state_size(parameters)), rows laid out as in `information.py`.
    """

    plants: int
    parameters: int
    forgetting: float
    covariance_limit: float
    memory: bytes


class Recursion:
    """Settings and state of the single and the vectorised form."""

    def __init__(
        self, plants: int, parameters: int, forgetting: float, covariance_limit: float | None, plants_in_tile: int
    ) -> None:
        if plants < 1:
            raise InputError(f"plants must be at least 1, got {plants}")
        if parameters < 1:
            raise InputError(f"parameters must be at least 1, got {parameters}")
        if covariance_limit is None:
            covariance_limit = math.inf if forgetting == 1.0 else DEFAULT_COVARIANCE_LIMIT
        if not covariance_limit > 1.0 / LARGEST_VALUE:
            raise InputError(f"covariance_limit must be above {1.0 / LARGEST_VALUE}, got {covariance_limit}")
        self._plants = plants
        self._parameters = parameters
        self._covariance_limit = float(covariance_limit)
        self._rank_share = information.RANK_SHARE if math.isinf(self._covariance_limit) else 0.0
        self._set_forgetting(forgetting)
        start = 1.0 / (self._covariance_limit * self._forgetting ** (parameters - 1))
        tiles = -(-plants // plants_in_tile)
        # The single form includes its work space: one argument fewer at each update.
        work = information.work_size(parameters) if plants_in_tile == 1 else 0
        self._tiles = np.zeros((tiles, information.state_size(parameters) + work, plants_in_tile))
        self._tiles[:, 2 * parameters : 3 * parameters] = start

    def _set_forgetting(self, forgetting: float) -> None:
        if not 0.0 < forgetting <= 1.0:
            raise InputError(f"forgetting must be in (0, 1], got {forgetting}")
        if forgetting < 1.0 and not self._covariance_limit < LARGEST_VALUE:
            raise InputError(
                f"covariance_limit must be below {LARGEST_VALUE} when forgetting < 1, got {self._covariance_limit}"
            )
        n, f = self._parameters, float(forgetting)
        self._forgetting = f
        self._renewal = (1.0 - f**n) / (self._covariance_limit * f ** (n - 1))

    @property
    def forgetting(self) -> float:
        """Weight of a row relative to its successor."""
        return self._forgetting

    @property
    def state(self) -> RlsState:
        """A copy of the full state."""
        size = information.state_size(self._parameters)
        memory = self._tiles[:, :size].transpose(0, 2, 1).reshape(-1, size)[: self._plants]
        return RlsState(
            self._plants,
            self._parameters,
            self._forgetting,
            self._covariance_limit,
            memory.astype("<f8").tobytes(),
        )

    def _load(self, memory: bytes) -> None:
        size = information.state_size(self._parameters)
        if len(memory) != 8 * size * self._plants:
            raise ValueError(
                f"state memory of {self._plants} plants with {self._parameters} parameters must have "
                f"{8 * size * self._plants} bytes, got {len(memory)}"
            )
        tiles, _, plants_in_tile = self._tiles.shape
        rows = np.tile(self._tiles[0, :size, 0], (tiles * plants_in_tile, 1))
        rows[: self._plants] = np.frombuffer(memory, dtype="<f8").reshape(self._plants, size)
        self._tiles[:, :size] = rows.reshape(tiles, plants_in_tile, size).transpose(0, 2, 1)


def describe_invalid(regressor: NDArray[np.float64], output: float) -> str:
    """Message for an invalid row."""
    for i, value in enumerate(regressor):
        if not abs(value) < LARGEST_VALUE:
            return f"regressor[{i}] must be a finite number below {LARGEST_VALUE:g} in size, got {value}"
    return f"output must be a finite number below {LARGEST_VALUE:g} in size, got {output}"
