"""One-step predictions of an output from its past and the input's, by two ARX models of the same structure.

One adapts at every row. The other is fitted to the whole training at its end, and held: the reference that residuals
are judged by. Until then the prediction is that of the model that adapts, made before it sees the row.

Where residuals are not judged by these models, the one that adapts has time: rows are put by, and learned from together
when somebody asks what it has come to.

Signals are scaled by the mean and the spread of the first rows, so that the estimator works with numbers of the order
of one; what is told of the models is in the signals' own units again.
"""

from math import inf, isfinite, nan

import numpy as np
from numpy.typing import NDArray

from monitor_node.baseline.training_record import checks_of
from monitor_node.ingest.sampling import TOLERANCE
from reactorwatch.contract.messages_pb2 import ModelSnapshot, Parameter
from reactorwatch.errors import InputError
from reactorwatch.identification.linear_model import standard_deviations
from reactorwatch.identification.recursion import RlsState
from reactorwatch.identification.regressor import BufferState, RegressorBuffer, Rows, rows_of
from reactorwatch.identification.rls import RecursiveLeastSquares
from reactorwatch.identification.structure import Scaling, Structure
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.charts.parameters import ParameterState, ParameterT2
from reactorwatch.spc.parameter_drift import learn
from reactorwatch.stored_state import StoredState, packed, unpacked

Array = NDArray[np.float64]

SCALING_ROWS = 50
"""Rows that the scaling is made from; nothing is predicted before."""

ROWS_A_PARAMETER = 10
"""The reference is not made from fewer rows than this times its parameters."""

MOST_PUT_BY = 1000
"""Rows that wait to be learned from; memory stays bounded."""

_BREAK = (-(2**63), nan, nan)
"""Stands between two rows of which the later does not follow the earlier."""


class PredictorState(StoredState, frozen=True):
    """All that a predictor remembers.

    Attributes:
        buffer: the rows that the next regressor needs.
        rls: the model that adapts.
        first_rows: that the scaling will be made from: doubles, input and output of each.
        scaling: of the signals; None before it is known.
        reference: its parameters, doubles; None while there is none.
        told: of the reference: a `ModelSnapshot`; None if nobody will ask.
        drift: the chart that compares the models; None: they are not compared.
        drifted: what it said last.
    """

    buffer: BufferState
    rls: RlsState
    first_rows: bytes
    scaling: Scaling | None
    reference: bytes | None
    told: bytes | None
    drift: ParameterState | None
    drifted: Judgement | None


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
        self._described = described
        self._put_by: list[tuple[int, float, float]] = []
        self._scaling: Scaling | None = None
        self._scales = (0.0, 1.0, 0.0, 1.0)
        self._reference: Array | None = None
        self._reference_model: ModelSnapshot | None = None
        self._fitted: Rows | None = None
        self._drift: ParameterT2 | None = None
        self._drifted: Judgement | None = None

    @property
    def state(self) -> PredictorState:
        """A copy of all that is remembered. Rows that were put by are learned from first, which changes nothing."""
        self.catch_up()
        return PredictorState(
            self._buffer.state,
            self._rls.state,
            packed(self._first_rows),
            self._scaling,
            None if self._reference is None else packed(self._reference),
            None if self._reference_model is None else self._reference_model.SerializeToString(),
            None if self._drift is None else self._drift.state,
            self._drifted,
        )

    def restore(self, state: PredictorState) -> None:
        """Go on, bit for bit, where a predictor of the same settings was when `state` was taken.

        Raises:
            ValueError: the state is damaged.
        """
        if state.buffer.structure != self._structure:
            raise ValueError(f"the state must be of {self._structure}, got {state.buffer.structure}")
        self._buffer = RegressorBuffer.from_state(state.buffer)
        self._rls = RecursiveLeastSquares.from_state(state.rls)
        self._first_rows = [(first, second) for first, second in unpacked(state.first_rows, 2).tolist()]
        if state.scaling is not None:
            self._scale(state.scaling)
        if state.reference is not None:
            (self._reference,) = unpacked(state.reference, self._structure.parameters)
        if state.told is not None:
            self._reference_model = ModelSnapshot.FromString(state.told)
        self._drift = None if state.drift is None else ParameterT2.from_state(state.drift)
        self._drifted = state.drifted

    def update(self, time_ns: int, input_value: float, value: float, *, follows: bool) -> float:
        """Take a row in.

        Args:
            time_ns: of the row; later than the last one's if it follows.
            input_value: NaN if missing.
            value: of the output, NaN if missing.
            follows: whether the row before was one period ago.

        Returns:
            What was to be expected of the output before it was seen; NaN where that can't be said.
        """
        if self._scaling is None:
            self._learn_scaling(input_value, value)
            return nan
        if self._put_by:
            self.catch_up()
        input_centre, input_spread, centre, spread = self._scales
        if not follows:
            self._buffer.restart()
        scaled = (value - centre) / spread
        regressor = self._buffer.update(time_ns, [(input_value - input_centre) / input_spread], [scaled])
        if regressor is None:
            return nan
        innovation = self._rls.update(regressor, scaled)
        if self._reference is not None:
            self._compare(regressor)
            return centre + spread * float(self._reference @ regressor)
        return centre + spread * innovation.prediction

    def hold(self, time_min: Array, inputs: Array, outputs: Array) -> Array:
        """Fit the reference to a training, by least squares.

        Args:
            time_min: shape (rows,).
            inputs: shape (rows,); NaN where missing.
            outputs: shape (rows,); NaN where missing or not to be learned from.

        Returns:
            The residual of each row, shape (rows,), as large as those of rows that it has not learned from; NaN where
            there is none. Of too few rows there is no reference, and all are NaN.
        """
        residual = np.full(time_min.size, nan)
        if self._scaling is None:
            return residual
        input_centre, input_spread, centre, spread = self._scales
        rows = rows_of(self._structure, (inputs - input_centre) / input_spread, (outputs - centre) / spread)
        rows = _following(rows, time_min, self._structure.history)
        parameters = self._structure.parameters
        if len(rows.outputs) < ROWS_A_PARAMETER * parameters:
            return residual
        y = rows.outputs[:, 0]
        theta: Array = np.asarray(np.linalg.lstsq(rows.regressors, y, rcond=1e-10)[0], dtype=np.float64)
        # With n parameters fitted to N rows, a row it has seen is off by sqrt((N - n) / (N + n)) of one it has not.
        seen = np.sqrt((len(y) - parameters) / (len(y) + parameters))
        residual[rows.position] = spread * (y - rows.regressors @ theta) / seen
        self._reference, self._fitted = theta, rows
        if self._described:
            covariance = _covariance(rows.regressors, y, theta)
            singular = np.linalg.svd(rows.regressors, compute_uv=False)
            condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else inf
            checks = checks_of(self._structure, time_min, inputs, outputs, residual)
            self._reference_model = self._told(theta, covariance, condition, len(y), 1.0)
            self._reference_model.checks.extend(checks)
        return residual

    def compare(self, arl0: float) -> None:
        """Begin to compare the model that adapts with the reference, by a chart on their parameters.

        Args:
            arl0: its run length without a fault, in rows.

        Raises:
            InputError: the training was too short for that, or the model does not forget.
        """
        self.catch_up()
        rows, self._fitted = self._fitted, None
        if rows is None:
            raise InputError("there is no reference to compare with")
        assert self._reference is not None
        names, lags = self._structure.parameter_names(), self._structure.output_lags
        residual = rows.outputs[:, 0] - rows.regressors @ self._reference
        self._drift = learn(rows.regressors, residual, self._rls.forgetting, len(residual), arl0, names, lags)

    def drift(self) -> tuple[Judgement, dict[str, float]] | None:
        """How far the models are from each other, and each parameter's part of that; None: not compared."""
        self.catch_up()
        if self._drift is None or self._drifted is None or self._reference is None:
            return None
        parts = self._drift.contributions(self._rls.parameters - self._reference)
        return self._drifted, dict(zip(self._drift.names, parts.tolist(), strict=True))

    def _compare(self, regressor: Array) -> None:
        if self._drift is not None and self._reference is not None:
            self._drifted = self._drift.update(self._rls.parameters - self._reference, regressor)

    def put_by(self, time_ns: int, input_value: float, value: float, *, follows: bool) -> None:
        """Take a row in that is to be learned from later, if ever; arguments as for `update`."""
        if self._scaling is None:
            self._learn_scaling(input_value, value)
            return
        if not follows:
            self._put_by.append(_BREAK)
        self._put_by.append((time_ns, input_value, value))
        if len(self._put_by) >= MOST_PUT_BY:
            self.catch_up()

    def catch_up(self) -> None:
        """Learn from the rows that were put by."""
        rows, self._put_by = self._put_by, []
        input_centre, input_spread, centre, spread = self._scales
        buffer, learn_row = self._buffer, self._rls.update
        for time_ns, input_value, value in rows:
            if time_ns == _BREAK[0]:
                buffer.restart()
                continue
            scaled = (value - centre) / spread
            regressor = buffer.update(time_ns, [(input_value - input_centre) / input_spread], [scaled])
            if regressor is not None:
                learn_row(regressor, scaled)
                self._compare(regressor)

    def adaptive(self) -> ModelSnapshot | None:
        """The model that adapts, without a time; None before it has learned anything."""
        self.catch_up()
        return self._describe() if self._rls.rows else None

    def reference(self) -> ModelSnapshot | None:
        """A copy of the reference, likewise; None while there is none."""
        if self._reference_model is None:
            return None
        told = ModelSnapshot()
        told.CopyFrom(self._reference_model)
        return told

    def _learn_scaling(self, input_value: float, value: float) -> None:
        if not (isfinite(input_value) and isfinite(value)):
            return
        self._first_rows.append((input_value, value))
        if len(self._first_rows) == SCALING_ROWS:
            rows = np.array(self._first_rows)
            self._scale(Scaling.of(rows[:, 0], rows[:, 1]))
            self._first_rows.clear()

    def _scale(self, scaling: Scaling) -> None:
        self._scaling = scaling
        self._scales = (
            scaling.input_centres[0],
            scaling.input_spreads[0],
            scaling.output_centres[0],
            scaling.output_spreads[0],
        )

    def _describe(self) -> ModelSnapshot:
        rls = self._rls
        return self._told(rls.parameters, rls.parameter_covariance, rls.condition, rls.rows, rls.forgetting)

    def _told(
        self, scaled: Array, scaled_covariance: Array, condition: float, rows: int, forgetting: float
    ) -> ModelSnapshot:
        assert self._scaling is not None
        matrix, shift = self._scaling.unscaling(self._structure)
        values = matrix @ scaled + shift
        deviations = standard_deviations(scaled_covariance, matrix)
        return ModelSnapshot(
            structure="arx",
            order=self._structure.output_lags,
            delay=self._structure.delay,
            parameters=[
                Parameter(name=name, value=value, sd=sd)
                for name, value, sd in zip(self._structure.parameter_names(), values, deviations, strict=True)
            ],
            rows=rows,
            forgetting=forgetting,
            excitation=1.0 / condition,
            condition=condition,
        )


def fewest_rows(order: int, delay: int) -> int:
    """Rows, one after the other, that a reference is made from at least.

    Args:
        order: of the models.
        delay: of the input, in samples.
    """
    structure = Structure.of_order(order, delay)
    return structure.history + ROWS_A_PARAMETER * structure.parameters


def _following(rows: Rows, time_min: Array, history: int) -> Rows:
    """Those rows that follow each other, with all their history, by one period, as is asked of the rows that come."""
    steps = np.diff(time_min)
    period = float(np.median(steps))
    late = np.abs(steps - period) > TOLERANCE * period
    number = np.arange(time_min.size)
    last_late = np.maximum.accumulate(np.where(np.concatenate([[True], late]), number, 0))
    kept = (number - last_late)[rows.position] >= history
    return Rows(rows.regressors[kept], rows.outputs[kept], rows.position[kept])


def _covariance(regressors: Array, outputs: Array, theta: Array) -> Array:
    """Of the parameters, by least squares; NaN where the rows do not tell them."""
    residual = outputs - regressors @ theta
    variance = float(residual @ residual) / max(len(outputs) - theta.size, 1)
    gram = regressors.T @ regressors
    try:
        return np.asarray(variance * np.linalg.inv(gram))
    except np.linalg.LinAlgError:
        return np.full(gram.shape, nan)
