"""Study of the diagnosis: hidden causes found, their sizes, and false causes in records without any.

Records of every class (`benchmarks/hidden/classes.py`) are drawn from fresh seeds, with a solver and equations that the
diagnosis does not use (`tests/hidden_effect/`), diagnosed in parallel, and held against the truth.

    python benchmarks/diagnosis_study.py [--quick] [--records N] [--suspects N] [--classes NAME ...] [--seed N]
                                         [--results FILE] [--write] [--jobs N] [--scheduler ADDRESS]

`--write` writes the tables into docs/diagnosis_study.md. All classes take hours: with `--results` a study that was
stopped continues, and classes can be run one after the other before all of them are written.
"""

import argparse
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.harness.study import Pool, add_options, replace_between, stamp
from benchmarks.hidden.classes import CLASSES, StudyClass, draw_record, find_class
from benchmarks.hidden.score import (
    SuspectsJudged,
    confusion_table,
    failures,
    judge_suspects,
    main_table,
    reliability_table,
)
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.process.library.cstr import cstr
from reactorwatch.runtime.jobs import Failed
from tests.hidden_effect.draw import draw
from tests.hidden_effect.judge import Judged, failed, judge

RECORDS, NOMINAL_RECORDS, QUICK_RECORDS = 96, 330, 13
SUSPECTS, QUICK_SUSPECTS = 52, 13
FIRST_SEED = 10_000_000
PAGE = Path(__file__).parents[1] / "docs" / "diagnosis_study.md"
BEGIN, END = "<!-- made by make study: begin -->", "<!-- made by make study: end -->"

TEMPLATE = """## Results

Made by `make study`, from seeds of {seed} on. Every record is drawn from a seed, made by equations and a solver that
the diagnosis does not use, and compared with the truth. The classes are in `benchmarks/hidden/classes.py`, the sizes of
the hidden causes in `tests/hidden_effect/catalogue.py`. {stamp}

{main}

- *first*: exactly the hidden causes are named. *listed*: they are named, or among the alternatives. *list*: the number
  of explanations listed. *wrong*: something is claimed that is not there.
- *place*: the location is right. *curve*: error of the whole profile, whatever its name.
- *held-out T*: the simulation error on rows that the fit did not see, over the noise that was drawn in those very rows
  (median / 90 %). Over the noise's standard deviation it scatters, because few rows are held out of a short record:
  `/ its sd` is that ratio, *the truth's* the same of the plant itself, *before* of the simulation without the cause.
- In brackets: 95 % interval of a share (Wilson).

### Reliability

{reliability}

- *not quite the model*: beside what is hidden, the plant has two constant deviations of the catalogue that are not to
  be found, each with a fifth of the smallest size that is worth finding.
- The probability of a verdict follows from the BIC of all listed explanations. A set of suspects is the smallest whose
  probabilities, at the monitor's last look, sum to 90 %.

### Confusion table

All classes with one hidden cause, or none.

{confusion}
"""

_warm = False
Job = tuple[str, int, int]
"""Name of a class, number of the record, and first seed."""


def main() -> None:
    """Run the study and print it."""
    chosen = arguments()
    pool, began = Pool.of(chosen), time.perf_counter()
    found: dict[str, list[Judged]] = {}
    for study in [find_class(name) for name in chosen.classes] if chosen.classes else CLASSES:
        jobs = [(study.name, number, chosen.seed) for number in range(_records(study, chosen))]
        found[study.name] = pool.run(study.name, judge_record, jobs, _judge_failure)
    alarms = [(number, nearly, chosen.seed) for number in range(_suspects(chosen)) for nearly in (False, True)]
    judged = pool.run("alarms", judge_suspects, alarms, lambda *_: None)
    suspects = [item for item in judged if item is not None]
    parts = main_table(found), reliability_table(found, suspects), confusion_table(found), "\n".join(failures(found))
    print("\n\n".join(parts))
    print(f"\n{sum(map(len, found.values()))} records, {time.perf_counter() - began:.0f} s, seeds from {chosen.seed}")
    if chosen.write:
        replace_between(PAGE, BEGIN, END, section(found, chosen.seed, suspects))


def _judge_failure(job: Job, outcome: Failed) -> Judged:
    name, number, first_seed = job
    return failed(draw_record(find_class(name), number, first_seed), outcome.reason, 0.0)


def judge_record(job: Job) -> Judged:
    """Draw, diagnose and judge one record."""
    name, number, first_seed = job
    warm_up()
    hidden = draw_record(find_class(name), number, first_seed)
    began = time.process_time()
    try:
        diagnosis = diagnose(hidden.record, cstr())
    except Exception as error:  # noqa: BLE001 # whatever it is, it is a result of the study
        return failed(hidden, f"{type(error).__name__}: {error}", time.process_time() - began)
    return judge(hidden, diagnosis, time.process_time() - began)


def warm_up() -> None:
    """Let the first diagnosis of a process, which loads compiled code, not count."""
    global _warm
    if not _warm:
        diagnose(draw(1).record, cstr())
        _warm = True


def section(found: Mapping[str, Sequence[Judged]], seed: int, suspects: Sequence[SuspectsJudged] = ()) -> str:
    """Section of the page on the study."""
    text = TEMPLATE.format(
        seed=seed,
        stamp=stamp(),
        main=main_table(found),
        reliability=reliability_table(found, suspects),
        confusion=confusion_table(found),
    )
    missed = failures(found)
    if missed:
        lines = "\n".join(f"- {line}" for line in missed)
        summary = f"Records whose cause was not named ({len(missed)})"
        text += f"\n<details><summary>{summary}</summary>\n\n{lines}\n\n</details>\n"
    return text


def _records(study: StudyClass, chosen: argparse.Namespace) -> int:
    if chosen.records is not None:
        return int(chosen.records)
    if chosen.quick:
        return QUICK_RECORDS
    return NOMINAL_RECORDS if study.kind == "nominal" else RECORDS


def _suspects(chosen: argparse.Namespace) -> int:
    if chosen.suspects is not None:
        return int(chosen.suspects)
    return 0 if chosen.classes else QUICK_SUSPECTS if chosen.quick else SUSPECTS


def arguments() -> argparse.Namespace:
    """Arguments of the command line."""
    parser = argparse.ArgumentParser(description="The diagnosis on records with something hidden in them.")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_RECORDS} records a class, for a try")
    parser.add_argument("--records", type=int, help=f"a class (default {RECORDS}, {NOMINAL_RECORDS} nominal ones)")
    parser.add_argument(
        "--suspects", type=int, help=f"alarms of each kind of plant (default {SUSPECTS}, with --classes 0)"
    )
    parser.add_argument("--classes", nargs="+", metavar="NAME", help=", ".join(item.name for item in CLASSES))
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="the first")
    parser.add_argument("--write", action="store_true", help=f"write the tables into {PAGE.name}")
    add_options(parser)
    return parser.parse_args()


if __name__ == "__main__":
    main()
