"""One-step predictions of an output from its past and the input's, by two ARX models of the same structure.

One adapts at every row. The other is a copy of it, made once and held: the reference that residuals are judged by.
Until the copy is made, the prediction is that of the model that adapts, made before it sees the row.

Where residuals are not judged by these models, the one that adapts has time: rows are put by, and learned from together
when somebody asks what it has come to.

Signals are scaled by the mean and the spread of the first rows, so that the estimator works with numbers of the order
of one; what is told of the models is in the signals' own units again.
"""

from math import isfinite, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from monitor_node.identification.regressor import RegressorBuffer
from monitor_node.identification.rls import RecursiveLeastSquares
from monitor_node.identification.structure import Scaling, Structure
from monitor_node.training_record import TrainingRecord
from reactorwatch.contract.messages_pb2 import Parameter

SCALING_ROWS = 50
"""Rows that the scaling is made from; nothing is predicted before."""

ROWS_A_PARAMETER = 10
"""The reference is not made from fewer rows than this times its parameters."""

MOST_PUT_BY = 1000
"""Rows that wait to be learned from; memory stays bounded."""

_BREAK = (-(2**63), nan, nan)
"""Stands between two rows of which the later does not follow the earlier."""


class ArxPredictor:
    """Predicts one output.

    Args:
        order: of the models.
        delay: of the input, in samples.
        forgetting: of the model that adapts.
        described: whether anybody will ask what the models are like.
    """

    def __init__(self, order: int, delay: int, forgetting: float, *, described: bool = True) -> None:
        self._structure = Structure.of_order(order, delay)
        self._rls = RecursiveLeastSquares(self._structure.parameters, forgetting)
        self._buffer = RegressorBuffer(self._structure)
        self._first_rows: list[tuple[float, float]] = []
        self._training = TrainingRecord() if described else None
        self._put_by: list[tuple[int, float, float]] = []
        self._scaling: Scaling | None = None
        self._scales = (0.0, 1.0, 0.0, 1.0)
        self._reference: NDArray[np.float64] | None = None
        self._reference_model: dict[str, Any] | None = None

    @property
    def has_reference(self) -> bool:
        """Whether the reference has been made."""
        return self._reference is not None

    def update(self, time_ns: int, input_value: float, value: float, *, follows: bool, hold_reference: bool) -> float:
        """Take a row in.

        Args:
            time_ns: of the row; later than the last one's if it follows.
            input_value: NaN if missing.
            value: of the output, NaN if missing.
            follows: whether the row before was one period ago.
            hold_reference: make the reference now if there is none and enough has been learned.

        Returns:
            What was to be expected of the output before it was seen; NaN where that can't be said.
        """
        if self._scaling is None:
            self._learn_scaling(input_value, value)
            return nan
        input_centre, input_spread, centre, spread = self._scales
        if not follows:
            self._buffer.restart()
        scaled = (value - centre) / spread
        regressor = self._buffer.update(time_ns, [(input_value - input_centre) / input_spread], [scaled])
        if regressor is None:
            if self._reference is None and self._training is not None:
                self._training.add(time_ns, input_value, value, nan)
            return nan
        innovation = self._rls.update(regressor, scaled)
        if self._reference is not None:
            return centre + spread * float(self._reference @ regressor)
        if self._training is not None:
            self._training.add(time_ns, input_value, value, spread * innovation.residual)
        if hold_reference and self._rls.rows >= ROWS_A_PARAMETER * self._structure.parameters:
            self._reference = self._rls.parameters
            if self._training is not None:
                checks = self._training.checks(self._structure)
                self._reference_model = self._describe() | {"checks": checks}
        return centre + spread * innovation.prediction

    def put_by(self, time_ns: int, input_value: float, value: float, *, follows: bool) -> None:
        """Take a row in that is to be learned from later; arguments as for `update`, after the scaling is known."""
        if not follows:
            self._put_by.append(_BREAK)
        self._put_by.append((time_ns, input_value, value))
        if len(self._put_by) >= MOST_PUT_BY:
            self.catch_up()

    def catch_up(self) -> None:
        """Learn from the rows that were put by."""
        rows, self._put_by = self._put_by, []
        input_centre, input_spread, centre, spread = self._scales
        buffer, learn = self._buffer, self._rls.update
        for time_ns, input_value, value in rows:
            if time_ns == _BREAK[0]:
                buffer.restart()
                continue
            scaled = (value - centre) / spread
            regressor = buffer.update(time_ns, [(input_value - input_centre) / input_spread], [scaled])
            if regressor is not None:
                learn(regressor, scaled)

    def adaptive(self) -> dict[str, Any] | None:
        """The model that adapts, as the fields of a `ModelSnapshot`; None before it has learned anything."""
        self.catch_up()
        return self._describe() if self._rls.rows else None

    def reference(self) -> dict[str, Any] | None:
        """The reference, likewise; None while there is none."""
        return self._reference_model

    def _learn_scaling(self, input_value: float, value: float) -> None:
        if not (isfinite(input_value) and isfinite(value)):
            return
        self._first_rows.append((input_value, value))
        if len(self._first_rows) == SCALING_ROWS:
            rows = np.array(self._first_rows)
            self._scaling = scaling = Scaling.of(rows[:, 0], rows[:, 1])
            self._scales = (
                scaling.input_centres[0],
                scaling.input_spreads[0],
                scaling.output_centres[0],
                scaling.output_spreads[0],
            )
            self._first_rows.clear()

    def _describe(self) -> dict[str, Any]:
        assert self._scaling is not None
        matrix, shift = self._scaling.undoing(self._structure)
        covariance = matrix @ self._rls.parameter_covariance @ matrix.T
        values = matrix @ self._rls.parameters + shift
        with np.errstate(invalid="ignore"):
            deviations = np.sqrt(np.diag(covariance))
        condition = self._rls.condition
        return {
            "structure": "arx",
            "order": self._structure.output_lags,
            "delay": self._structure.delay,
            "parameters": [
                Parameter(name=name, value=value, sd=sd)
                for name, value, sd in zip(self._structure.parameter_names(), values, deviations, strict=True)
            ],
            "rows": self._rls.rows,
            "forgetting": self._rls.forgetting,
            "excitation": 1.0 / condition,
            "condition": condition,
        }
