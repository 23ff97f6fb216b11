"""`causes`: the causes that sensors distinguish: JSON for programs, a matrix for people."""

from reactorwatch.cli.batch import as_table
from reactorwatch.cli.display import json_line
from reactorwatch.diagnosis.identifiability import TIMES, Identifiability

ALIKE, APART = "=", "."
"""Signs of the matrix."""


def as_json_text(found: Identifiability, process: str, rows: int) -> str:
    """Format as a JSON object."""
    seen = [item for item in found.causes if item.is_visible]
    report = {
        "process": process,
        "rows": rows,
        "causes": [item.effect.name for item in found.causes],
        "smallest_size": {item.effect.name: {"value": item.smallest, "unit": item.effect.unit} for item in seen},
        "alike": [list(group) for group in found.alike],
        "invisible": [item.effect.name for item in found.causes if not item.is_visible],
    }
    return json_line(report)


def as_matrix(found: Identifiability, process: str, rows: int) -> str:
    """Format as a matrix: a row for each cause, with a sign for each other one of its number."""
    group_of = {name: group for group in found.alike for name in group}
    names = [item.effect.name for item in found.causes]
    lines = []
    for number, item in enumerate(found.causes, start=1):
        name, unit = item.effect.name, "" if item.effect.unit == "1" else f" {item.effect.unit}"
        alike = group_of.get(name, ())
        signs = "".join(
            str(number % 10) if other == name else ALIKE if other in alike else APART if item.is_visible else " "
            for other in names
        )
        size = f"{item.smallest:.2g}{unit}" if item.is_visible else "never"
        lines.append({"no.": str(number), "cause": name, "seen from": size, "distinct": signs})
    text = [
        f"{process}: {len(names)} causes over {rows} rows; a column for each, in the same order",
        as_table(lines),
        f"{ALIKE} looks the same at {TIMES:g} times the smallest size, {APART} does not",
    ]
    text += [f"alike: {', '.join(group)}" for group in found.alike]
    return "\n".join(text)
