"""Reference that predicts rows; residuals are taken against it.

The references: the extended Kalman filter of a process model (`process_reference`), a black box of few signals
(`black_box_reference`), and the recursive ARX models (`arx_reference`).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

GATE = 6.0
"""Standard deviations beyond which a residual does not correct the filter until the next one confirms it."""


class RowPrediction(NamedTuple):
    """One-step-ahead prediction of a row.

    Attributes:
        prediction: predicted outputs in their units; NaN where there is none.
        sd: standard deviations of the residuals in the same units; 1 if unknown.
        extrapolation: for tests that need every row, predictions with their standard deviations that include those
            where the reference knows too little of the point of operation for charts; None: they are the same.
    """

    prediction: Sequence[float]
    sd: Sequence[float]
    extrapolation: tuple[Sequence[float], Sequence[float]] | None = None


class Reference(Protocol):
    """Predicts rows.

    Attributes:
        kind: `equations`, `black-box` or `arx`, as published.
    """

    kind: str

    def update(
        self, time_ns: int, inputs: Sequence[float], values: list[float], accept: tuple[bool, ...], missing: int = 0
    ) -> RowPrediction:
        """Predict a row, then update with it.

        Args:
            time_ns: time of the row.
            inputs: one value an input; NaN if missing.
            values: outputs; NaN if missing.
            accept: outputs that correct the reference whatever their residual.
            missing: number of rows missing just before this one.
        """

    def restart(self) -> None:
        """Restart with the next row: the plant's clock was set, or there was a gap."""

    @property
    def state(self) -> Any:
        """The state, without the equations."""
