"""A monitor takes no more memory the longer it watches: objects are counted, which no other process disturbs."""

import gc
from collections import Counter
from functools import partial

import numpy as np
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.bus_zenoh.messages import cache_size

from .fleets import fleet, of_plant
from .samples import leaking_run, samples

TRAINING_ROWS, ROUND = 200, 400
CACHE_MESSAGES = 10_000
ROUNDS = 4
"""Each has an alarm, a silence and what cannot be used; the first two fill what is bounded."""

CONFIG = MonitorConfig(training_min=TRAINING_ROWS / 10, isolation=False)


@pytest.fixture(scope="module")
def rows() -> list[list[Encoded]]:
    """The messages of each row; none of the rows of a silence."""
    span_min = (TRAINING_ROWS + ROUNDS * ROUND) / 10
    time_min, columns = leaking_run(0.0, 1.0, span_min, seed=4)
    messages = list(samples(time_min, columns | {"T": columns["T"] + 5.0 * _is_disturbed(len(time_min))}))
    silent = {row for first in _starts() for row in range(first + 300, first + 330)}
    return [[] if row in silent else messages[3 * row : 3 * row + 3] for row in range(len(time_min))]


def _starts() -> range:
    return range(TRAINING_ROWS, TRAINING_ROWS + ROUNDS * ROUND, ROUND)


def _is_disturbed(count: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """1 in the rows in which T is off, 0 in the others."""
    disturbed = np.zeros(count)
    for first in _starts():
        disturbed[first + 100 : first + 150] = 1.0
    return disturbed


def garbage(row: int) -> list[Encoded]:
    """Messages that no plant publishes, under a new name in each row."""
    return [
        Encoded(f"reactor/cstr/sample/x{row}", b"?", "text/plain"),
        Encoded("reactor/cstr/sample/T", b"?", f"text/{row}"),
        Encoded(f"reactor/cstr/alarm/x{row}", b"?", "text/plain"),
    ]


def objects() -> Counter[str]:
    gc.collect()
    return Counter(type(item).__name__ for item in gc.get_objects())


def growth(before: Counter[str], after: Counter[str]) -> dict[str, int]:
    """Kinds of objects of which there are more than a handful more."""
    return {name: count for name, count in (after - before).items() if count > 20}


def test_a_monitor_holds_as_many_objects_after_each_round(rows: list[list[Encoded]]) -> None:
    monitor, counts, sizes = Monitor(CONFIG, 0), list[Counter[str]](), list[int]()
    for row, messages in enumerate(rows):
        for message in (*messages, *garbage(row)):
            monitor.on_message(message, row * 10**9)
        monitor.on_tick(row * 10**9)
        if row >= TRAINING_ROWS and (row - TRAINING_ROWS) % ROUND == ROUND - 1:
            counts.append(objects())
            sizes.append(len(monitor.to_bytes()))
    assert monitor.alarms.incident > 0
    assert growth(counts[1], counts[-1]) == {}
    assert sizes[-1] < sizes[1] + 200


def test_a_fleet_s_monitor_holds_as_many_objects_after_each_round(rows: list[list[Encoded]]) -> None:
    """Names are made up all the time, and one plant is left and taken up again, as after a cut."""
    node = fleet(CONFIG)
    for plant in ("a", "b"):
        node.on_alive(f"reactor/{plant}/alive/plant", True, 0)
    counts = list[Counter[str]]()
    for row, messages in enumerate(rows):
        strange = [item for plant in ("a", "b") for item in of_plant(plant, garbage(row))]
        known = [item for plant in ("a", "b") for item in of_plant(plant, messages)]
        made_up = [Encoded(f"reactor/made-up-{row}/sample/T", b"?", "")] if row % 40 == 0 else []
        node.on_messages([*known, *strange, *made_up], row * 10**9)
        node.on_tick(row * 10**9)
        if row >= TRAINING_ROWS and (row - TRAINING_ROWS) % ROUND == ROUND - 1:
            for monitor in map(node.monitor, node.plants):
                monitor.intake.rejects.report(row * 10**9)
                monitor.notes.clear()
            counts.append(objects())
    assert growth(counts[1], counts[-1]) == {}


def test_all_that_publishers_keep_in_full_is_published_with_every_row() -> None:
    """What comes less often and is kept in full takes more memory for days, until there are `cache_messages` of it."""
    training_rows, watched_rows = 600, 200
    monitor, counts = Monitor(MonitorConfig(training_min=training_rows / 10, isolation=False), 0), Counter[str]()
    time_min, columns = leaking_run(0.0, 1.0, (training_rows + watched_rows) / 10, seed=4)
    for number, message in enumerate(samples(time_min, columns)):
        counts.update(told.key for told in monitor.on_message(message, number * 10**9))
    kept = {key for key in counts if cache_size(key, CACHE_MESSAGES) == CACHE_MESSAGES}
    chart = partial(keys.key, "cstr", keys.CHART)
    assert {chart("ewma/T"), chart("shewhart/T"), keys.key("cstr", keys.ESTIMATE, "T")} <= kept
    assert {chart("parameters/T"), keys.key("cstr", keys.MODEL, "T")} <= counts.keys() - kept
    assert {key: counts[key] for key in kept if counts[key] < 0.9 * watched_rows} == {}
