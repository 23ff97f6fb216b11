"""Scaled signals of a record, to which a model of a structure is fitted."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.arrays import Array
from reactorwatch.errors import UnfitRecordError
from reactorwatch.identification.regressor import Rows, rows_of
from reactorwatch.identification.simulation import RunPlan, plan_run
from reactorwatch.identification.structure import ALL_ROWS, RowChoice, Scaling, Structure, as_columns


@dataclass(frozen=True, eq=False)
class ScaledRecord:
    """Scaled signals of a record, to which a model of a structure is fitted.

    Attributes:
        structure: terms of the model.
        scaling: scaling of the signals.
        u: scaled inputs, shape (rows, inputs), NaN where nothing was measured.
        y: scaled output, shape (rows, 1), NaN where nothing was measured.
        time: times of the rows, shape (rows,), increasing, in any unit; None: gaps are not detected.
    """

    structure: Structure
    scaling: Scaling
    u: Array
    y: Array
    time: ArrayLike | None = None

    @classmethod
    def of(cls, structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Self:
        """Scale a record; arguments as for `batch.fit_arx`.

        Raises:
            InputError: shapes that don't fit the structure, or an output whose measured values are all equal.
        """
        u = as_columns(inputs, "inputs", structure.inputs)
        y = as_columns(outputs, "outputs", 1)
        values = y[np.isfinite(y)]
        if values.size and np.ptp(values) == 0.0:
            raise UnfitRecordError(f"output 1 is constant, {values[0]:g} in all rows: there is nothing to identify")
        scaling = Scaling.of(u, y, centred=structure.offset)
        return cls(structure, scaling, scaling.inputs(u), scaling.outputs(y), time)

    @cached_property
    def plan(self) -> RunPlan:
        """Rows that a simulation covers."""
        return plan_run(self.structure, self.u, self.y, self.time)

    def rows(self, choice: RowChoice = ALL_ROWS) -> Rows:
        """Rows that can be predicted, see `rows_of`."""
        return rows_of(self.structure, self.u, self.y, self.time, choice)

    def enough_rows(self, choice: RowChoice = ALL_ROWS) -> Rows:
        """Rows that can be predicted, enough of them to determine the parameters.

        Raises:
            InputError: there are fewer rows than parameters.
        """
        rows = self.rows(choice)
        usable, parameters = rows.regressors.shape
        if usable < parameters:
            raise UnfitRecordError(
                f"{parameters} parameters need at least {parameters} rows that are complete and follow complete rows "
                f"without a gap, got {usable} of {len(self.y)}"
            )
        return rows
