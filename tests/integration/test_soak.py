"""A fleet runs for a minute while its processes are killed, its links cut and garbage comes; ten minutes: `make soak`.

The same code with 20 plants instead of 200, five times faster, and without diagnoses of the trainings: the time goes
into starting processes, and on a machine with other things to do 200 plants would be late, which says nothing. What
happens is counted in rows of the plants, which wait for it, so that a slow machine does the same, later. A minute is
too short for memory to be level, as buffers grow to what the first flood wants; only what grows without end would be
found.

On a Dask cluster there are five rows a second, as a worker that was stopped or cut off is away for thirty seconds.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import pytest
from msgspec.structs import replace

from benchmarks.soak.__main__ import soak, table
from benchmarks.soak.findings import ROW_NS, Change, Judged, Strike, count_unaccounted, why_not_once
from benchmarks.soak.plan import CLUSTER_KINDS, KINDS, draw_plan
from reactorwatch.contract.messages_pb2 import Health

ROWS = 500
ROWS_PER_S = 10.0
PLANTS = 20
SEED = 1
GROWTH_MB = 150.0

EWMA, SHEWHART = "ewma/T", "shewhart/T"


@pytest.mark.slow
def test_in_a_minute_of_kills_cuts_and_garbage_no_sample_is_unaccounted_for_and_each_fault_alarmed_once(
    tmp_path: Path,
) -> None:
    plan = draw_plan(SEED, PLANTS, ROWS, ROWS_PER_S)
    plan = plan._replace(monitor=replace(plan.monitor, diagnose_training=False))
    assert {(blow.kind, blow.manner) for blow in plan.blows} == set(KINDS)
    findings = soak(plan, tmp_path)
    broken = list(findings.failures(GROWTH_MB))
    assert not broken, "\n".join([*broken, table(plan, findings)])
    assert (findings.alarmed_once, len(findings.memory_mb)) == (len(plan.faults), 5)
    assert {"monitor 1", "plants 1", "plants 2"} <= findings.grown_mb.keys()


@pytest.mark.slow
def test_on_a_cluster_every_sample_is_judged_once_whatever_is_killed_stopped_or_cut_off(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="Dask (reactorwatch[cluster]) is not installed")
    plan = draw_plan(SEED, PLANTS, rows=800, rows_per_s=5.0, shards=3)
    plan = plan._replace(monitor=replace(plan.monitor, diagnose_training=False))
    findings = soak(plan, tmp_path)
    broken = list(findings.failures(GROWTH_MB, recovery_s=math.inf, cpu_percent=math.inf))
    assert not broken, "\n".join([*broken, table(plan, findings)])
    assert findings.placement is not None
    skipped = {"cut worker"} if findings.placement.skipped else set()
    assert {kind for kind, _ in findings.placement.recoveries} == CLUSTER_KINDS.keys() - skipped
    assert findings.alarmed_once == len(plan.faults)


@pytest.mark.parametrize(
    ("is_gradual", "recovery_s"),
    [(False, 12.0), (True, 15.0)],
)
def test_a_shard_has_recovered_when_a_row_after_the_blow_was_judged_of_each_of_its_plants(
    is_gradual: bool, recovery_s: float
) -> None:
    """The blow comes at 100 s, after row 50; where monitors end later, the old one of `a` still judges."""
    strike = Strike("kill worker", 50, 100.0, ("a", "b"), is_gradual)
    judged = {
        "a": [Judged(99.0, 51, 0.0), Judged(103.0, 60, 0.0), Judged(115.0, 60, 110.0)],
        "b": [Judged(99.0, 51, 0.0), Judged(110.0, 51, 110.0), Judged(112.0, 60, 110.0)],
    }
    assert strike.recovery_s(judged) == recovery_s
    assert strike.recovery_s(judged | {"b": judged["b"][:2]}) is None


@pytest.mark.parametrize(
    ("health", "samples"),
    [
        (Health(rows=100), 0),
        (Health(rows=99), 3),
        (Health(rows=99, lost=3), 0),
        (Health(rows=99, lost=2, late=1), 0),
        (Health(rows=100, incomplete_rows=1), 1),
        (Health(rows=100, incomplete_rows=1, late=1), 0),
        (Health(rows=101), 3),
        (Health(rows=101, incomplete_rows=1), 1),
    ],
)
def test_samples_are_accounted_for_that_are_in_rows_or_counted(health: Health, samples: int) -> None:
    """Of 100 rows that were published, three samples each."""
    assert count_unaccounted(health, rows=100) == samples


def changes(*events: tuple[int, str, str]) -> list[Change]:
    return [Change(row * ROW_NS, alarm, event) for row, alarm, event in events]


@pytest.mark.parametrize(
    ("told", "once"),
    [
        (changes((50, EWMA, "raised"), (52, SHEWHART, "raised")), True),
        (changes((50, EWMA, "raised"), (60, EWMA, "cleared"), (70, EWMA, "raised")), True),
        (changes(), False),
        (changes((49, EWMA, "raised")), False),
        (changes((90, EWMA, "raised")), False),
        (changes((50, EWMA, "raised"), (50, EWMA, "raised")), False),
    ],
    ids=["once", "again when it was over", "never", "before the fault", "long after it", "twice"],
)
def test_a_fault_is_alarmed_once_if_an_alarm_comes_soon_and_none_comes_again_while_it_stands(
    told: Sequence[Change], once: bool
) -> None:
    """The fault sets in with row 50."""
    assert (why_not_once(told, 50 * ROW_NS) is None) == once


def test_the_same_seed_is_the_same_plan_and_another_is_another() -> None:
    assert draw_plan(1, PLANTS, ROWS, ROWS_PER_S) == draw_plan(1, PLANTS, ROWS, ROWS_PER_S)
    assert draw_plan(1, PLANTS, ROWS, ROWS_PER_S) != draw_plan(2, PLANTS, ROWS, ROWS_PER_S)
