"""Soak test: a fleet keeps its promises over a long run, under all disturbances.

A router, two monitors with a shard of the fleet and a folder of states each, two processes of plants and a source of
garbage run for minutes. From a seed: a quarter of the plants get a large fault each, at a time of its own;
monitors and the router are killed and started again, links are cut for seconds, floods come. In the end every sample is
accounted for, every fault was alarmed once, and memory is level: see `findings`.

    python -m benchmarks.soak [minutes] [plants] [seed] [rows a second of each plant] [--cluster]

With `--cluster` the shards are placed on a Dask cluster instead, and what is killed, stopped and cut off is its
workers, the scheduler and the command that places them: see `cluster`.
"""

import contextlib
import dataclasses
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.soak.cluster import Cluster
from benchmarks.soak.findings import Findings, Placement, assess, count_unaccounted
from benchmarks.soak.plan import KNOWN_ROWS, Plan, draw_plan
from benchmarks.soak.site import MONITORS, Site, Witness
from reactorwatch.runtime.node_main import configure_log

MINUTES, PLANTS = 10.0, 200
ROWS_PER_S = 2.0
CLUSTER, SHARDS = "--cluster", 5
CATCH_UP_S = 60.0
"""A monitor that evaluates no row for this long has finished."""


def soak(plan: Plan, folder: Path, *, tell: bool = False) -> Findings:
    """Run a soak and assess it."""
    zero_ns = time.time_ns()
    make = Cluster if plan.shards else Site
    with make(plan, folder, zero_ns) as site, contextlib.closing(Witness(site.bus)) as witness:
        site.start_monitors()
        witness.wait_for_monitors(plan.shards or MONITORS)
        site.start_plants()
        site.allow(KNOWN_ROWS)
        site.wait_for_row(KNOWN_ROWS - 1)
        site.begin_disturbances()
        for blow in plan.blows:
            site.allow(blow.row + 1)
            site.wait_for_row(blow.row)
            if tell:
                print(
                    f"row {site.row:6d}: {blow.kind}, {blow.manner} for {blow.rows} rows, {blow.monitor + 1}",
                    flush=True,
                )
            site.disturb(blow, witness)
        site.allow(plan.rows)
        site.wait_for_row(plan.rows - 1)
        garbage = site.end_garbage()
        rows = -1
        while rows < (rows := sum(item.rows for item in witness.health.values())):  # as long as they go on
            if witness.wait(lambda: all(_is_complete(plan, witness, plant) for plant in plan.plants), CATCH_UP_S):
                break
        lag_ms = witness.longest_lag_ms
        findings = assess(plan, zero_ns, witness.alarms, witness.health, lag_ms, garbage, site.memory)
        placement = site.placement(witness) if isinstance(site, Cluster) else None
        return dataclasses.replace(findings, placement=placement)


def _is_complete(plan: Plan, witness: Witness, plant: str) -> bool:
    """True if the health of a plant's monitor accounts for all of its samples."""
    health = witness.health.get(plant)
    return health is not None and not count_unaccounted(health, plan.rows)


def table(plan: Plan, findings: Findings) -> str:
    """Format the findings as text."""
    refused = ", ".join(f"{count:,} {reason}" for reason, count in sorted(findings.refused.items()))
    lines = [
        f"samples published                   {findings.published:,} of {len(plan.plants)} plants",
        f"  rows that were judged             {findings.rows:,}, of them incomplete {findings.incomplete}",
        f"  lost, late                        {findings.lost}, {findings.late}",
        f"  unaccounted for                   samples of {len(findings.unaccounted)} plants",
        f"  repeated and dropped              {findings.duplicated:,}",
        f"garbage messages, of them refused   {findings.garbage:,}, {sum(findings.refused.values()):,} ({refused})",
        f"faults, of them alarmed once        {findings.faults}, {findings.alarmed_once}",
        f"plants with a false alarm           {len(findings.false_alarms)}",
        f"plants not as undisturbed           {len(findings.others)}",
        f"silences, raised twice, standing    {findings.silences}, {findings.silences_raised_twice}, "
        f"{findings.standing_silences}",
        f"longest wait in a monitor           {findings.lag_ms / 1e3:.1f} s; {findings.stalls} stalls of a second",
    ]
    if findings.placement is not None:
        lines += _placement_lines(findings.placement)
    for name, (first, middle, last) in findings.memory_mb.items():
        grown = findings.grown_mb.get(name)
        change = "restarted" if grown is None else f"median {grown:+.1f} MB from the second to the last"
        lines.append(
            f"own memory of {name:21s} at most {first:.0f}, {middle:.0f}, {last:.0f} MB in the thirds; {change}"
        )
    return "\n".join(lines)


def _placement_lines(placement: Placement) -> Iterator[str]:
    """Format the findings about the placement."""
    for what, items in (
        ("all plants judged again", placement.recoveries),
        ("monitors from before end", placement.ends),
    ):
        for kind in dict.fromkeys(kind for kind, _ in items):
            times = ("never" if after_s is None else f"{after_s:.1f}" for other, after_s in items if other == kind)
            yield f"{kind:35s} {what} after {', '.join(times)} s"
    if placement.skipped:
        yield f"cut worker                          skipped: {placement.skipped}"
    shares = ", ".join(f"{name} {percent:.2f}" for name, percent in placement.cpu_percent.items())
    yield f"placement, % of a core              {sum(placement.cpu_percent.values()):.2f} ({shares})"
    yield f"starts                              {', '.join(f'{name}: {n}' for name, n in placement.starts.items())}"


def main() -> int:
    """Run a soak and print its findings; returns 1 if it failed."""
    configure_log()
    numbers = [argument for argument in sys.argv[1:] if argument != CLUSTER]
    minutes = float(numbers[0]) if numbers else MINUTES
    plants = int(numbers[1]) if len(numbers) > 1 else PLANTS
    seed = int(numbers[2]) if len(numbers) > 2 else time.time_ns() % 1_000_000
    rows_per_s = float(numbers[3]) if len(numbers) > 3 else ROWS_PER_S
    shards = SHARDS if CLUSTER in sys.argv else 0
    plan = draw_plan(seed, plants, round(60.0 * minutes * rows_per_s), rows_per_s, shards)
    print(
        f"seed {seed}: {plants} plants, {plan.rows} rows, {rows_per_s:g} a second, {len(plan.blows)} blows", flush=True
    )
    folder = Path(tempfile.mkdtemp(prefix="soak-"))
    findings = soak(plan, folder, tell=True)
    print(table(plan, findings))
    broken = list(findings.failures())
    for line in broken:
        print(f"BROKEN: {line}")
    if broken:
        print(f"the logs of the monitors are in {folder}")
    else:
        shutil.rmtree(folder)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
