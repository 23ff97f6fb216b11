"""Recursive identification of ARX models: regressors, scaling and least squares in one."""

from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.identification.batch import LeastSquares, linear_model
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.recursion import RlsState
from reactorwatch.identification.regressor import BufferState, RegressorBuffer
from reactorwatch.identification.rls import RecursiveLeastSquares, RlsUpdate
from reactorwatch.identification.structure import ALL_ROWS, RowChoice, Scaling, Structure
from reactorwatch.stored_state import StoredState


class RecursiveArxState(StoredState, frozen=True):
    """State of a `RecursiveArx`.

    Attributes:
        scaling: scaling of the signals.
        buffer: the rows that the next regressor needs.
        estimators: one for each output.
    """

    scaling: Scaling
    buffer: BufferState
    estimators: tuple[RlsState, ...]


class RecursiveArx:
    """Predicts each row of all outputs before it learns from it.

    Args:
        structure: the model's terms.
        scaling: scaling of the signals; without it they are taken as they are, which suits signals of the order of 1.
        forgetting: weight of a row relative to its successor, in (0, 1].
        covariance_limit: see `RecursiveLeastSquares`.
        period_ns: time between rows; None: gaps are not detected.
        choice: rows to learn from.
        start: a model of the same structure to start from.

    Raises:
        ValueError: a setting out of its range.
    """

    def __init__(
        self,
        structure: Structure,
        scaling: Scaling | None = None,
        forgetting: float = 1.0,
        covariance_limit: float | None = None,
        period_ns: int | None = None,
        choice: RowChoice = ALL_ROWS,
        start: LinearModel | None = None,
    ) -> None:
        self._structure = structure
        self._scaling = Scaling.none(structure.inputs, structure.outputs) if scaling is None else scaling
        self._buffer = RegressorBuffer(structure, period_ns, choice)
        self._estimators = [
            RecursiveLeastSquares(structure.parameters, forgetting, covariance_limit) for _ in range(structure.outputs)
        ]
        if start is not None:
            if start.structure != structure:
                raise ValueError(f"the model to start from must have the structure {structure}, got {start.structure}")
            for o, estimator in enumerate(self._estimators):
                estimator.set_parameters(self._scaling.scale_parameters(structure, start.parameters[o], o))

    @classmethod
    def from_state(cls, state: RecursiveArxState) -> Self:
        """Resume, bit for bit from a state.

        Raises:
            ValueError: the state is damaged.
        """
        buffer = state.buffer
        model = cls(buffer.structure, state.scaling, period_ns=buffer.period_ns, choice=buffer.choice)
        model._buffer = RegressorBuffer.from_state(buffer)
        model._estimators = [RecursiveLeastSquares.from_state(estimator) for estimator in state.estimators]
        return model

    @property
    def state(self) -> RecursiveArxState:
        """A copy of the full state."""
        estimators = tuple(estimator.state for estimator in self._estimators)
        return RecursiveArxState(self._scaling, self._buffer.state, estimators)

    def update(self, time_ns: int, inputs: ArrayLike, outputs: ArrayLike) -> tuple[RlsUpdate, ...] | None:
        """Predict the outputs of a row, then learn from it.

        Args:
            time_ns: time of the row.
            inputs: shape (inputs,), NaN for what was not measured.
            outputs: shape (outputs,), NaN for what was not measured.

        Returns:
            One innovation an output, in its own unit. None for a row that cannot be predicted (not enough complete
            rows before it), is not complete, or is not chosen.

        Raises:
            ValueError: a time not after the last one's, or a wrong number of values; nothing is changed then.
        """
        measured = self._scaling.outputs(outputs)
        regressor = self._buffer.update(time_ns, self._scaling.inputs(inputs), measured)
        if regressor is None:
            return None
        updates = (
            estimator.update(regressor, output) for estimator, output in zip(self._estimators, measured, strict=True)
        )
        return tuple(
            unscale(innovation, centre, spread)
            for innovation, centre, spread in zip(
                updates, self._scaling.output_centres, self._scaling.output_spreads, strict=True
            )
        )

    def predict(self) -> NDArray[np.float64] | None:
        """Predict the outputs of the next row, shape (outputs,); None while the history fills."""
        regressor = self._buffer.upcoming
        if regressor is None:
            return None
        scaled = np.array([estimator.predict(regressor) for estimator in self._estimators])
        return np.asarray(scaled * self._scaling.output_spreads + self._scaling.output_centres)

    @property
    def rows(self) -> int:
        """Number of rows learned from."""
        return self._estimators[0].rows

    @property
    def model(self) -> LinearModel:
        """The learned model, in the signals' own units."""
        return model_of(self._structure, self._scaling, self._estimators, simulates=False)


def unscale(innovation: RlsUpdate, centre: float, spread: float) -> RlsUpdate:
    """Convert an update of a scaled output to that output's unit."""
    return RlsUpdate(
        innovation.prediction * spread + centre,
        innovation.residual * spread,
        innovation.residual_sd * spread,
        innovation.leverage,
    )


def model_of(
    structure: Structure, scaling: Scaling, estimators: list[RecursiveLeastSquares], simulates: bool
) -> LinearModel:
    """Make a model from estimators of scaled signals, one for each output."""
    models = [
        linear_model(
            structure,
            scaling,
            LeastSquares(
                estimator.parameters[None, :],
                estimator.unit_covariance,
                np.array([estimator.noise_variance]),
                estimator.condition,
            ),
            estimator.rows,
            simulates,
            first_output=o,
        )
        for o, estimator in enumerate(estimators)
    ]
    return LinearModel(
        structure,
        np.concatenate([model.parameters for model in models]),
        np.concatenate([model.covariance for model in models]),
        np.concatenate([model.noise_sd for model in models]),
        max(model.condition for model in models),
        models[0].rows,
        simulates,
    )
