"""Does a fleet keep its promises for as long as it runs, whatever befalls it?

A router, two monitors that share the fleet and keep its states in a folder, two processes of plants and a stranger who
publishes garbage run for minutes. From a seed: a quarter of the plants get a large fault each, at a time of its own;
monitors and the router are killed and started again, links are cut for seconds, floods come. In the end every sample is
accounted for, every fault was alarmed once, and memory is level: see `findings`.

    python -m benchmarks.soak [minutes] [plants] [seed] [rows a second of each plant]
"""

import contextlib
import shutil
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.soak.findings import Findings, found, unaccounted
from benchmarks.soak.plan import KNOWN_ROWS, Plan, drawn
from benchmarks.soak.site import MONITORS, Site
from benchmarks.soak.witness import Witness
from reactorwatch.runtime import logs

MINUTES, PLANTS = 10.0, 200
ROWS_PER_S = 2.0
CATCH_UP_S = 60.0
"""Who judges no row for so long has no more."""


def soak(plan: Plan, folder: Path, *, tell: bool = False) -> Findings:
    """Run it, and judge it.

    Args:
        plan: what happens.
        folder: for settings, states and what the monitors say; empty.
        tell: whether each blow is printed.
    """
    zero_ns = time.time_ns()
    with Site(plan, folder, zero_ns) as site, contextlib.closing(Witness(site.bus)) as witness:
        site.start_monitors()
        witness.wait_for_crew(MONITORS)
        site.start_plants()
        site.allow(KNOWN_ROWS)
        site.wait_for_row(KNOWN_ROWS - 1)
        site.begin_garbage()
        for blow in plan.blows:
            site.allow(blow.row + 1)
            site.wait_for_row(blow.row)
            if tell:
                print(
                    f"row {site.row:6d}: {blow.kind}, {blow.manner} for {blow.rows} rows, {blow.whom + 1}", flush=True
                )
            site.suffer(blow, witness.wait_for_crew)
        site.allow(plan.rows)
        site.wait_for_row(plan.rows - 1)
        strange = site.end_stranger()
        rows = -1
        while rows < (rows := sum(item.rows for item in witness.health.values())):  # as long as they go on
            if witness.wait(lambda: all(_is_heard(plan, witness, plant) for plant in plan.plants), CATCH_UP_S):
                break
        return found(plan, zero_ns, witness.alarms, witness.health, witness.longest_lag_ms, strange, site.memory)


def _is_heard(plan: Plan, witness: Witness, plant: str) -> bool:
    """Whether a plant's monitor has said that it has judged all of it, or has lost it."""
    health = witness.health.get(plant)
    return health is not None and not unaccounted(health, plan.rows)


def table(plan: Plan, findings: Findings) -> str:
    """What was found, as text."""
    refused = ", ".join(f"{count:,} {reason}" for reason, count in sorted(findings.refused.items()))
    lines = [
        f"samples published                   {findings.published:,} of {len(plan.plants)} plants",
        f"  rows that were judged             {findings.rows:,}, of them incomplete {findings.incomplete}",
        f"  lost, late                        {findings.lost}, {findings.late}",
        f"  unaccounted for                   samples of {len(findings.unaccounted)} plants",
        f"  told again and passed over        {findings.duplicated:,}",
        f"strange messages, of them refused   {findings.strange:,}, {sum(findings.refused.values()):,} ({refused})",
        f"faults, of them alarmed once        {findings.faults}, {findings.alarmed_once}",
        f"plants with a false alarm           {len(findings.false_alarms)}",
        f"plants not as undisturbed           {len(findings.others)}",
        f"silences, told twice, standing      {findings.silences}, {findings.silences_told_twice}, "
        f"{findings.standing_silences}",
        f"longest wait in a monitor           {findings.lag_ms / 1e3:.1f} s; {findings.stalls} stalls of a second",
    ]
    for name, (first, middle, last) in findings.memory_mb.items():
        grown = findings.grown_mb.get(name)
        change = "restarted" if grown is None else f"median {grown:+.1f} MB from the second to the last"
        lines.append(
            f"own memory of {name:21s} at most {first:.0f}, {middle:.0f}, {last:.0f} MB in the thirds; {change}"
        )
    return "\n".join(lines)


def main() -> int:
    """Soak, and print what was found; 1 if anything is not as it has to be."""
    logs.configure()
    minutes = float(sys.argv[1]) if len(sys.argv) > 1 else MINUTES
    plants = int(sys.argv[2]) if len(sys.argv) > 2 else PLANTS
    seed = int(sys.argv[3]) if len(sys.argv) > 3 else time.time_ns() % 1_000_000
    rows_per_s = float(sys.argv[4]) if len(sys.argv) > 4 else ROWS_PER_S
    plan = drawn(seed, plants, round(60.0 * minutes * rows_per_s), rows_per_s)
    print(
        f"seed {seed}: {plants} plants, {plan.rows} rows, {rows_per_s:g} a second, {len(plan.blows)} blows", flush=True
    )
    folder = Path(tempfile.mkdtemp(prefix="soak-"))
    findings = soak(plan, folder, tell=True)
    print(table(plan, findings))
    broken = list(findings.broken())
    for line in broken:
        print(f"BROKEN: {line}")
    if broken:
        print(f"what the monitors said is in {folder}")
    else:
        shutil.rmtree(folder)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
