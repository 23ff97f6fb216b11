"""`make promise`: false alarms on sound plants that are not quite the model, and faults seen on such plants."""

import argparse
import time
from collections.abc import Sequence

from benchmarks import false_alarms
from benchmarks.promise import black_box, costs, faults, statements
from benchmarks.promise.not_quite import print_plants
from benchmarks.promise.plants import KINDS
from reactorwatch.runtime.executors import choose_executor


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", type=int, default=len(KINDS), help="number of kinds of plants")
    parser.add_argument("--processes", type=int, help="processes that work side by side (default: one a core)")
    parser.add_argument("--plants-only", action="store_true", help="without the tables of the other modules")
    options = parser.parse_args(arguments)
    executor, start = choose_executor(options.processes), time.perf_counter()
    print_plants(executor, options.kinds)
    if not options.plants_only:
        print("\n## Without equations\n")
        black_box.print_table(executor, black_box.jobs_of(black_box.SEEDS))
        print("\n## Medium faults, on a plant as the model\n")
        faults.print_table(executor, faults.SEEDS)
        print("\n## Statements held to simulation\n")
        statements.print_tables(executor)
        print("\n## Noise with memory\n")
        false_alarms.print_table(executor)
        print("\n## Costs\n")
        costs.main()
    print(f"\n{time.perf_counter() - start:.0f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
