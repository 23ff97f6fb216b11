"""A fleet's monitor compiles before it joins: what took seconds while plants wait would look as if it were gone."""

from collections import defaultdict
from types import ModuleType
from typing import Any

import numba
import pytest

from monitor_node.fleet.packed import plants
from monitor_node.fleet.plant_kinds import ANY, PlantKind
from monitor_node.fleet.watched_plants import WatchedPlants
from reactorwatch.contract import sample_bytes
from reactorwatch.identification import information

from ..fleets import QUICK, SECOND_NS, fleet, row_by_row, run_of

LONG_COMPILED: tuple[tuple[ModuleType, str], ...] = (
    (plants, "step_rows"),
    (plants, "take_samples"),
    (plants, "find_deadlines"),
    (information, "learn_one"),
    (sample_bytes, "_read"),
)


def test_what_is_called_while_plants_are_watched_was_compiled_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba compiles a kernel anew for arguments of other types."""
    types: defaultdict[str, set[Any]] = defaultdict(set)
    for module, name in LONG_COMPILED:
        kernel = getattr(module, name)

        def noting(*arguments: Any, name: str = name, kernel: Any = kernel) -> Any:
            types[name].add(tuple(map(numba.typeof, arguments)))
            return kernel(*arguments)

        monkeypatch.setattr(module, name, noting)
    WatchedPlants([PlantKind(ANY, QUICK, None)], 0, points=False).prepare()
    before = {name: set(found) for name, found in types.items()}
    watching = fleet()
    messages = row_by_row([run_of("a", 1), run_of("b", 2)])
    for begin in range(0, len(messages), 60):
        watching.on_messages(messages[begin : begin + 60], SECOND_NS)
        watching.on_tick(SECOND_NS)
    assert watching.quiet
    assert set(before) == {name for _, name in LONG_COMPILED}
    assert types == before
