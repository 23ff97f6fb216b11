"""`make promise`: false alarms on sound plants that are not quite the model, and faults seen on such plants.

python -m benchmarks.promise [--only plants|black-box|faults|statements|foreign|slow|arx] [--results FILE] [--jobs N]
"""

import argparse
import time
from collections.abc import Callable, Sequence

from benchmarks.harness.plants import FLOWS, KINDS, NOISE_SD
from benchmarks.harness.study import Pool, add_options
from benchmarks.promise import arx, black_box, foreign_plants, slow, statements
from benchmarks.promise.not_quite import print_plants


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    names = ("plants", "black-box", "faults", "statements", "foreign", "slow", "arx")
    parser.add_argument("--only", choices=names, help="one of the tables")
    parser.add_argument("--kinds", type=int, default=len(KINDS), help="number of kinds of plants")
    parser.add_argument("--seeds", type=int, help="records of each kind (6), runs of each fault (3), or sets (1)")
    parser.add_argument("--noise", default=",".join(NOISE_SD), help="levels of noise of the records without equations")
    parser.add_argument("--inputs", default=",".join(FLOWS), help="inputs of the records without equations")
    parser.add_argument("--reference", choices=("auto", "black-box", "arx"), default="auto")
    parser.add_argument("--plants", type=int, default=statements.PLANTS, help="plants for each length of the training")
    parser.add_argument("--runs", type=int, default=statements.RUNS, help="faults injected for each size")
    add_options(parser)
    options = parser.parse_args(arguments)
    pool, start = Pool.of(options), time.perf_counter()
    jobs = black_box.jobs_of(options.seeds or 6, options.reference, options.noise.split(","), options.inputs.split(","))
    tables: dict[str, tuple[str, Callable[[], None]]] = {
        "plants": ("Plants that are not quite the model", lambda: print_plants(pool, options.kinds)),
        "black-box": ("Without equations", lambda: black_box.print_table(pool, jobs)),
        "faults": ("Medium faults, on a plant as the model", lambda: black_box.print_faults(pool, options.seeds or 3)),
        "statements": (
            "Statements held to simulation",
            lambda: statements.print_tables(pool, options.plants, options.runs),
        ),
        "foreign": ("Plants of others", lambda: foreign_plants.print_tables(pool, options.seeds or 1)),
        "arx": ("RLS ARX beside plain ARX", lambda: arx.print_table(pool, options.seeds or 4)),
        "slow": ("Slow changes", lambda: slow.print_tables(pool, options.seeds or 1)),
    }
    for name, (title, print_table) in tables.items():
        if options.only in (None, name):
            print(f"\n## {title}\n")
            print_table()
    print(f"\n{time.perf_counter() - start:.0f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
