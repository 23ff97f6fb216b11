"""Results in Python: their fields, figures and pages, and the origin of a page."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from datetime import datetime
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from reactorwatch import html
from reactorwatch.figures import Panel, draw
from reactorwatch.records.record import Record
from reactorwatch.records.write import atomic_write
from reactorwatch.results.base import Result
from reactorwatch.version import this_build

if TYPE_CHECKING:
    from matplotlib.figure import Figure

R = TypeVar("R", bound=Result)


class Drawn(ABC):
    """A record or a result that has a figure and a page."""

    @abstractmethod
    def _panels(self) -> list[Panel]:
        """Panels of the figure."""

    @abstractmethod
    def _page(self) -> str:
        """The page as HTML."""

    def plot(self) -> "Figure":
        """Plot the signals over time, with what the result says of them.

        Raises:
            InputError: matplotlib is not installed.
        """
        return draw(self._panels())

    def to_html(self, file: str | Path) -> None:
        """Write tables and plots as one page.

        Raises:
            InputError: the file cannot be written.
        """
        with atomic_write(Path(file)) as temporary:
            temporary.write_text(self._page(), encoding="utf-8")


class Shown(Drawn, Generic[R]):
    """A result with its record, to be shown in a notebook.

    Attributes:
        result: the result, whose fields are attributes of this object, too.
        record: the record.
    """

    def __init__(self, result: R, record: Record) -> None:
        self.result, self.record = result, record

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "result":  # as of a copy that is not filled yet
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self.result, name)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *(name for name in vars(type(self.result)) if not name.startswith("_"))})

    def to_dict(self) -> dict[str, Any]:
        """The object that the command prints with `--json`; numbers that are not finite are None."""
        return self.result.to_dict()


def page_of(title: str, body: str, panels: Sequence[Panel], source: str) -> str:
    """Page with the figures of a result, the result and its origin.

    Args:
        title: title of the page.
        body: the result as HTML.
        panels: figures.
        source: name of the record.
    """
    origin = html.fold("This report", html.table(("", ""), report_origin(Path(source), {}).items()))
    heading = f"<h1>{escape(title)}</h1>"
    return html.page(title, heading, *map(html.figure, panels), f'<div class="wide">{body}</div>', origin)


def report_origin(file: Path, settings: Mapping[str, object]) -> dict[str, str]:
    """Origin of a report, by name.

    Args:
        file: the file that was read, or a folder of recordings.
        settings: what was chosen; empty values are left out.
    """
    chosen = ", ".join(f"{name} {_format(value)}" for name, value in settings.items() if value)
    parts = {
        "made": datetime.now().astimezone().strftime("%Y-%m-%d %H:%M:%S %z"),
        "software": f"reactorwatch {this_build()}",
        "file": str(file),
        "SHA-256 of the file": file_hash(file) if file.is_file() else "",
        "settings": chosen or "default",
    }
    return {name: text for name, text in parts.items() if text}


def file_hash(file: Path) -> str:
    """SHA-256 of a file as hexadecimal digits."""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _format(value: object) -> str:
    if isinstance(value, dict):
        return " ".join(f"{name}={item}" for name, item in value.items())
    return str(value)
