"""The commands, the Python and the settings of a page of documentation, in order, with its marks on how to run them.

A mark is a comment above a block, of clauses with semicolons between them:

    <!-- run: given record.csv, rig.csv; until connected -->

Above a table, its commands are run; those within sentences and within tables without a mark are parsed and not run.

| clause | says |
|---|---|
| `given FILE, ...` | these are there, made by `tests/end_to_end/given.py` |
| `until PATTERN` | each command is started, prints this before the next one begins, and runs on beside it |
| `in order` | as without a mark; above a table, that its commands are run |
| `others end` | what runs beside it is ended before |
| `ends with N or M` | its exit code, where that is not 0 alone |
| `not here: REASON` | it is not run |
| `file NAME` | of settings, JSON or a process in Python: it is written there |
"""

import re
import shlex
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PROGRAMS = ("reactorwatch", "make", "pip", "python", "dask", "rerun", ".venv/bin/rerun", "docker", "cp", "systemctl")
"""What a line of an indented block begins with if the block is one of commands."""

Kind = Literal["commands", "python", "toml", "json", "other"]

_MARK = re.compile(r"<!-- run: (.*) -->")
_FENCE = re.compile(r"```(\w*)$")
_FENCED: dict[str, Kind] = {"console": "commands", "python": "python", "toml": "toml", "json": "json"}


@dataclass
class Block:
    """Lines of a page that are not prose.

    Attributes:
        line: number of its first line on the page.
        kind: how it is run.
        text: its lines.
        clauses: of its mark, by their first words.
    """

    line: int
    kind: Kind
    text: str
    clauses: dict[str, str] = field(default_factory=dict)

    @property
    def commands(self) -> list[str]:
        """The lines that are typed; in a block with a prompt the others are what is answered."""
        lines = [line for line in self.text.splitlines() if line.strip()]
        if any(line.startswith("$ ") for line in lines):
            return [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
        return lines


CLAUSES = ("in order", "given", "until", "others end", "ends with", "not here:", "file")


def blocks(text: str) -> list[Block]:
    """The blocks of a page, in order.

    Raises:
        ValueError: a mark with a clause that does not exist.
    """
    found: list[Block] = []
    lines = text.splitlines()
    clauses: dict[str, str] = {}
    index = 0
    while index < len(lines):
        line, start = lines[index], index
        fence, mark = _FENCE.match(line), _MARK.fullmatch(line)
        index += 1
        if mark:
            clauses = dict(_clause(part.strip(), start + 1) for part in mark[1].split(";"))
        elif line.startswith("|") and clauses:
            while index < len(lines) and lines[index].startswith("|"):
                index += 1
            commands = _joined(f"$ {command}" for command in inline_commands(_joined(lines[start:index])))
            found.append(Block(start + 1, "commands", commands, clauses))
            clauses = {}
        elif fence:
            while lines[index] != "```":
                index += 1
            found.append(Block(start + 2, _FENCED.get(fence[1], "other"), _joined(lines[start + 1 : index]), clauses))
            index, clauses = index + 1, {}
        elif line.startswith("    ") and (start == 0 or not lines[start - 1].strip() or _MARK.match(lines[start - 1])):
            while index < len(lines) and (lines[index].startswith("    ") or not lines[index].strip()):
                index += 1
            body = _joined(item[4:] for item in lines[start:index])
            typed = body.lstrip("$ ").split(maxsplit=1)[0] in PROGRAMS
            found.append(Block(start + 1, "commands" if typed else "other", body, clauses))
            clauses = {}
    return found


def inline_commands(text: str) -> list[str]:
    """Commands of this software within sentences and tables."""
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.findall(r"(?<!`)`(reactorwatch [^`]+)`", prose)


def words(command: str) -> list[str]:
    """The words of a command as a shell splits them, without its comment."""
    return shlex.split(command, comments=True)


def _clause(part: str, line: int) -> tuple[str, str]:
    for name in CLAUSES:
        if part == name or part.startswith(f"{name} "):
            return name, part.removeprefix(name).strip()
    raise ValueError(f"line {line}: {part!r} is no clause of a mark, which are {', '.join(CLAUSES)}")


def _joined(lines: Iterable[str]) -> str:
    return "\n".join(lines).rstrip() + "\n"
