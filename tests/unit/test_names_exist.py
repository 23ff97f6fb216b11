"""Names of files, modules and functions in docs, docstrings and comments exist."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("reactorwatch", "plant_node", "monitor_node", "recorder", "diagnosis_node", "benchmarks", "tests")
FOLDERS = (".github", *PACKAGES, "docs", "deploy")
DOCUMENTS = sorted(
    [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "tests" / "README.md", *(ROOT / "docs").rglob("*.md")]
)

FILE = re.compile(r"(?<![\w./-])[\w./-]*\w\.(?:py|md|proto|service|yml)\b(?!\.)")
"""Endings of files of this repository; settings and recordings are the users'."""
LEADING = re.compile(r"^(?:\.{0,2}/)+")
QUOTED = re.compile(r"(?<!`)`([a-z_][a-z0-9_]*(?:\.[a-z_][a-z0-9_]*)*)`(?!`)")
COMMENT = re.compile(r"(?:^|\s)#\s(.*)$", re.MULTILINE)
WORD = re.compile(r"\w+")

WRITTEN = re.compile(r"<!-- run: file (\S+) -->")
MADE = {"summary.md"}.union(*(WRITTEN.findall(path.read_text(encoding="utf-8")) for path in DOCUMENTS))
"""Files that the commands write, and those that a page shows for the reader to write."""
PREFIXES = ("reactorwatch_", "process_", "keep_", "_total")
"""Parts of names that the code puts together: metrics (tests/end_to_end/test_metrics.py has them all) and settings."""
ELSEWHERE = ("nohup", "openssl", "trustme", "uv", "zenohd")
"""Names of other programs, that no code of this repository has."""


@cache
def split(path: Path) -> tuple[str, str]:
    """The code of a file without docstrings and comments, and these."""
    text = path.read_text(encoding="utf-8")
    lines, prose = text.splitlines(), []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            prose.append(node.value.value)
            for number in range(node.lineno - 1, node.end_lineno or node.lineno):
                lines[number] = ""
    code = "\n".join(lines)
    return COMMENT.sub("", code), "\n".join([*prose, *COMMENT.findall(code)])


@cache
def sources() -> list[Path]:
    return sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py") if path != Path(__file__))


@cache
def files() -> frozenset[str]:
    """Paths, and their ends: `monitor_node/fleet.py`, `monitor_node/fleet.py` and `monitor.py`."""
    paths = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*")]
    parts = [path.relative_to(ROOT).parts for path in (*ROOT.iterdir(), *paths)]
    return frozenset("/".join(part[start:]) for part in parts for start in range(len(part)))


@cache
def names() -> frozenset[str]:
    """Words of the code, modules and folders."""
    words = (WORD.findall(split(path)[0]) for path in sources())
    parts = (part.partition(".")[0] for file in files() for part in file.split("/"))
    tools = (WORD.findall((ROOT / name).read_text(encoding="utf-8")) for name in ("pyproject.toml", "Makefile"))
    return frozenset(ELSEWHERE).union(*words, *tools, parts)


def texts() -> Iterator[tuple[Path, str]]:
    yield from ((path, split(path)[1]) for path in sources())
    yield from ((path, path.read_text(encoding="utf-8")) for path in DOCUMENTS)


def missing_files(text: str) -> list[str]:
    """Files that a text names and that do not exist."""
    named = (LEADING.sub("", name) for name in FILE.findall(text) if "://" not in name)
    return [name for name in named if name not in MADE and name not in files()]


def missing_names(text: str) -> list[str]:
    """Quoted names in a text that no code has."""
    quoted = (name for name in QUOTED.findall(text) if not name.startswith(PREFIXES))
    return [name for name in quoted if name.rpartition(".")[2] not in names()]


def test_files_that_are_named_exist() -> None:
    found = {str(path.relative_to(ROOT)): missing for path, text in texts() if (missing := missing_files(text))}
    assert found == {}


def test_names_in_docstrings_comments_and_docs_exist() -> None:
    found = {str(path.relative_to(ROOT)): missing for path, text in texts() if (missing := missing_names(text))}
    assert found == {}


@pytest.mark.parametrize(
    ("text", "missing"),
    [
        ("what is done is in `output_watch.py`", ["output_watch.py"]),
        ("see watch/pipeline.py", []),
        ("see charts/rows.py", ["charts/rows.py"]),
        ("[x](../monitor_node/ingest/alignment.py)", []),
    ],
)
def test_a_file_that_does_not_exist_is_found(text: str, missing: list[str]) -> None:
    assert missing_files(text) == missing


def test_a_name_that_does_not_exist_is_found() -> None:
    assert missing_names("see `quiet_plants`, `packed.rows` and `MonitorConfig`") == ["quiet_plants"]
