"""Read the time plots of a dashboard file.

So the drawing of a diagnosis is reused in the dashboard of its run.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from reactorwatch.errors import InputError
from recorder.dashboard.stream import SAMPLE_TIME
from recorder.panels.base import Colour, Series, TimePlot

_HELD = rr.components.InterpolationMode.StepAfter.value


def read_time_plots(path: Path) -> list[TimePlot]:
    """Time plots of a dashboard in the order of the layout, with units in their titles.

    Raises:
        InputError: the file does not exist or is no Rerun file.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    try:
        reader = RrdReader(path)
        titles = _titles(list(_chunks(reader, reader.blueprints())))
        lines = _lines(_chunks(reader, reader.recordings()))
    except (RuntimeError, ValueError, IndexError) as error:
        raise InputError(f"{path}: is no dashboard: {error}") from error
    return [
        TimePlot(title, "", tuple(line.series(name) for (origin, name), line in lines.items() if origin == wanted))
        for wanted, title in titles.items()
    ]


@dataclass
class _Line:
    """Data of a line, collected from the chunks of its entity."""

    style: dict[str, Any] = field(default_factory=dict)
    times: list[NDArray[np.int64]] = field(default_factory=list)
    values: list[NDArray[np.float64]] = field(default_factory=list)

    def series(self, name: str) -> Series:
        time_ns = np.concatenate(self.times or [np.empty(0, np.int64)])
        value = np.concatenate(self.values or [np.empty(0)])
        order = np.argsort(time_ns, kind="stable")
        red, green, blue, _ = int(self.style.get("colors", 0xFFFFFFFF)).to_bytes(4, "big")
        legend = str(self.style.get("names", name))
        return Series(
            name,
            time_ns[order],
            value[order],
            Colour(red, green, blue),
            width=float(self.style.get("widths", 1.5)),
            held=self.style.get("interpolation_mode") == _HELD,
            legend="" if legend == name else legend,
        )


def _chunks(reader: Any, stores: list[Any]) -> Iterator[tuple[str, Any]]:
    """(entity, record batch) of the chunks of the first store."""
    for chunk in reader.stream(store=stores[0]).to_chunks():
        yield str(chunk.entity_path), chunk.to_record_batch()


def _titles(blueprint: list[tuple[str, Any]]) -> dict[str, str]:
    """Titles of the time plots by path, in the order of the containers."""
    views, contents = {}, []
    for entity, batch in blueprint:
        components = {name: batch.column(name)[-1].as_py() for name in batch.schema.names if ":" in name}
        if components.get("ViewBlueprint:class_identifier") == ["TimeSeries"]:
            views[entity] = (components["ViewBlueprint:space_origin"][0], components["ViewBlueprint:display_name"][0])
        contents += [f"/{item.lstrip('/')}" for item in components.get("ContainerBlueprint:contents") or []]
    return dict(views[item] for item in contents if item in views)


def _lines(recording: Iterator[tuple[str, Any]]) -> dict[tuple[str, str], _Line]:
    """Lines by path of their plot and name, sorted."""
    lines: dict[tuple[str, str], _Line] = {}
    for entity, batch in recording:
        origin, _, last = entity.rpartition("/")
        line = lines.setdefault((origin, re.sub(r"\\(.)", r"\1", last)), _Line())
        names = batch.schema.names
        if "Scalars:scalars" in names:
            line.times.append(batch.column(SAMPLE_TIME).cast("int64").to_numpy())
            line.values.append(batch.column("Scalars:scalars").flatten().to_numpy())
        for name in (name for name in names if name.startswith("SeriesLines:")):
            line.style[name.removeprefix("SeriesLines:")] = batch.column(name)[-1].as_py()[0]
    return dict(sorted(lines.items()))
