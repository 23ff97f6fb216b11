"""Result of a simulation along a record."""

from typing import ClassVar

from reactorwatch.results.base import Result


class Rmse(Result, frozen=True):
    """Root mean square difference between a simulated and a measured output.

    Attributes:
        value: the difference.
        unit: unit of the output.
    """

    value: float
    unit: str


class SimulationReport(Result, frozen=True):
    """Difference of a simulation from the record; its fields are those of `reactorwatch simulate --json`.

    Attributes:
        file: file of the simulation; None: it could not be written.
        rows: number of rows.
        runs: number of runs of the record.
        rmse: difference from the record, by output.
        remarks: remarks on the range of laws in the model; None: it has none.
        notes: remarks on the record.
    """

    file: str | None
    rows: int
    runs: int
    rmse: dict[str, Rmse]
    remarks: list[str] | None = None
    notes: tuple[str, ...] = ()

    python_only: ClassVar = ("notes",)
