"""The time plots in a dashboard file, read back.

So a diagnosis is drawn once, where all about it is known, and shown again where its run is.
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
    """The time plots of a dashboard in the order in which they are laid out, their units in their titles.

    Raises:
        InputError: there is no such file, or it is not one of Rerun's.
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
    """What is known of a line, from the chunks of its entity."""

    look: dict[str, Any] = field(default_factory=dict)
    times: list[NDArray[np.int64]] = field(default_factory=list)
    values: list[NDArray[np.float64]] = field(default_factory=list)

    def series(self, name: str) -> Series:
        time_ns = np.concatenate(self.times or [np.empty(0, np.int64)])
        value = np.concatenate(self.values or [np.empty(0)])
        order = np.argsort(time_ns, kind="stable")
        red, green, blue, _ = int(self.look.get("colors", 0xFFFFFFFF)).to_bytes(4, "big")
        legend = str(self.look.get("names", name))
        return Series(
            name,
            time_ns[order],
            value[order],
            Colour(red, green, blue),
            width=float(self.look.get("widths", 1.5)),
            held=self.look.get("interpolation_mode") == _HELD,
            legend="" if legend == name else legend,
        )


def _chunks(reader: Any, stores: list[Any]) -> Iterator[tuple[str, Any]]:
    """(entity, record batch) of the chunks of the first of some stores."""
    for chunk in reader.stream(store=stores[0]).to_chunks():
        yield str(chunk.entity_path), chunk.to_record_batch()


def _titles(blueprint: list[tuple[str, Any]]) -> dict[str, str]:
    """The titles of the time plots by where they are drawn, in the order of the containers."""
    views, contents = {}, []
    for entity, batch in blueprint:
        there = {name: batch.column(name)[-1].as_py() for name in batch.schema.names if ":" in name}
        if there.get("ViewBlueprint:class_identifier") == ["TimeSeries"]:
            views[entity] = (there["ViewBlueprint:space_origin"][0], there["ViewBlueprint:display_name"][0])
        contents += [f"/{item.lstrip('/')}" for item in there.get("ContainerBlueprint:contents") or []]
    return dict(views[item] for item in contents if item in views)


def _lines(recording: Iterator[tuple[str, Any]]) -> dict[tuple[str, str], _Line]:
    """The lines by the plot that they are in and their name, in the order of their names."""
    found: dict[tuple[str, str], _Line] = {}
    for entity, batch in recording:
        origin, _, last = entity.rpartition("/")
        line = found.setdefault((origin, re.sub(r"\\(.)", r"\1", last)), _Line())
        names = batch.schema.names
        if "Scalars:scalars" in names:
            line.times.append(batch.column(SAMPLE_TIME).cast("int64").to_numpy())
            line.values.append(batch.column("Scalars:scalars").flatten().to_numpy())
        for name in (name for name in names if name.startswith("SeriesLines:")):
            line.look[name.removeprefix("SeriesLines:")] = batch.column(name)[-1].as_py()[0]
    return dict(sorted(found.items()))
