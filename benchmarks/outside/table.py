"""Tables of the outside benchmarks."""

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Row:
    """A row of a table."""

    method: str  # name of the method
    settings: str  # settings that it was run with
    cells: dict[str, str] = field(default_factory=dict)  # values by the name of their column


def markdown(rows: Sequence[Row]) -> str:
    """Rows as a Markdown table; a cell that a row does not have stays empty."""
    columns = list(dict.fromkeys(name for row in rows for name in row.cells))
    head = f"| method | settings | {' | '.join(columns)} |\n|---|---|{'---|' * len(columns)}"
    lines = [
        f"| {row.method} | {row.settings} | {' | '.join(row.cells.get(name, '') for name in columns)} |" for row in rows
    ]
    return "\n".join([head, *lines])
