"""Study of the diagnosis: hidden causes found, their sizes, and false causes in records without any.

Records of every class (`benchmarks/hidden/classes.py`) are drawn from fresh seeds, with a solver and equations that the
diagnosis does not use (`tests/hidden_effect/`), diagnosed in parallel, and held against the truth.

    python benchmarks/diagnosis_study.py [--quick] [--records N] [--suspects N] [--jobs N] [--scheduler ADDRESS]
                                         [--classes NAME ...] [--seed N] [--json FILE] [--from FILE ...] [--write]

`--write` writes the tables into docs/diagnosis_study.md. All classes take hours; one after the other, each with
`--json`, they can be put together by `--from`.
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import msgspec
from rich.console import Console
from rich.progress import Progress

from benchmarks.hidden.classes import CLASSES, StudyClass, draw_record, find_class
from benchmarks.hidden.reliability import reliability_table
from benchmarks.hidden.suspects import SuspectsJudged, judge_suspects
from benchmarks.hidden.tables import confusion_table, failures, main_table
from benchmarks.stamp import stamp
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.process.library.cstr import cstr
from reactorwatch.runtime.parallel import choose_executor
from reactorwatch.runtime.parallel.jobs import Failed
from tests.hidden_effect.draw import draw
from tests.hidden_effect.judge import Judged, failed, judge

RECORDS, NOMINAL_RECORDS, QUICK_RECORDS = 96, 330, 13
SUSPECTS, QUICK_SUSPECTS = 52, 13
SUSPECTS_KEY = "suspects"
"""Key of the monitor's suspects in a JSON file, beside the names of the classes."""

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


def main() -> None:
    """Run the study and print it."""
    chosen = arguments()
    if chosen.earlier:
        report(*earlier(chosen.earlier), chosen, 0.0)
        return
    classes = [find_class(name) for name in chosen.classes] if chosen.classes else list(CLASSES)
    tasks = [(study, number) for study in classes for number in range(_records(study, chosen))]
    began = time.perf_counter()
    found: dict[str, list[Judged]] = {study.name: [] for study in classes}
    with Progress(console=Console(stderr=True)) as progress:
        bar = progress.add_task("diagnoses", total=len(tasks))
        jobs = [(study.name, number, chosen.seed) for study, number in tasks]
        executor = choose_executor(chosen.jobs, chosen.scheduler)
        for number, outcome in executor.map_unordered(judge_one, jobs):
            study, of_class = tasks[number]
            found[study.name].append(
                failed(draw_record(study, of_class, chosen.seed), outcome.reason, 0.0)
                if isinstance(outcome, Failed)
                else outcome
            )
            progress.advance(bar)
        alarms = [(number, nearly, chosen.seed) for number in range(_suspects(chosen)) for nearly in (False, True)]
        bar = progress.add_task("alarms", total=len(alarms))
        suspects: list[SuspectsJudged] = []
        for _, judged in executor.map_unordered(judge_alarm, alarms):
            if isinstance(judged, SuspectsJudged):
                suspects.append(judged)
            progress.advance(bar)
    for items in found.values():
        items.sort(key=lambda item: item.seed)
    report(found, suspects, chosen, time.perf_counter() - began)


def report(
    found: dict[str, list[Judged]], suspects: Sequence[SuspectsJudged], chosen: argparse.Namespace, seconds: float
) -> None:
    """Print what was found and write it where it was asked for."""
    print(main_table(found))
    print()
    print(reliability_table(found, suspects))
    print()
    print(confusion_table(found))
    print()
    print("\n".join(failures(found)))
    print(f"\n{sum(map(len, found.values()))} records, {seconds:.0f} s, seeds from {chosen.seed}")
    if chosen.json is not None:
        numbers = {name: [asdict(item) for item in items] for name, items in found.items()}
        numbers[SUSPECTS_KEY] = [asdict(item) for item in suspects]
        chosen.json.write_text(json.dumps(numbers, indent=1) + "\n")
    if chosen.write:
        PAGE.write_text(with_section(PAGE.read_text(), section(found, chosen.seed, suspects)))


def earlier(files: Sequence[Path]) -> tuple[dict[str, list[Judged]], list[SuspectsJudged]]:
    """Read earlier results, written by `--json`, in the order of the classes, and the suspects."""
    found: dict[str, list[Judged]] = {}
    suspects: list[SuspectsJudged] = []
    for file in files:
        for name, items in json.loads(file.read_text()).items():
            if name == SUSPECTS_KEY:
                suspects += msgspec.convert(items, list[SuspectsJudged])
            else:
                found[name] = msgspec.convert(items, list[Judged])
    return {study.name: found[study.name] for study in CLASSES if study.name in found}, suspects


def judge_one(job: tuple[str, int, int]) -> Judged:
    """Call `judge_record` with class, number and first seed in one."""
    return judge_record(*job)


def judge_alarm(job: tuple[int, bool, int]) -> SuspectsJudged | None:
    """Call `judge_suspects` with number, kind of plant and first seed in one."""
    return judge_suspects(*job)


def judge_record(name: str, number: int, first_seed: int) -> Judged:
    """Draw, diagnose and judge one record."""
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


def section(found: dict[str, list[Judged]], seed: int, suspects: Sequence[SuspectsJudged] = ()) -> str:
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


def with_section(page: str, text: str) -> str:
    """A page with what stands between the marks exchanged."""
    if BEGIN not in page or END not in page:
        raise ValueError(f"{PAGE.name} must hold the marks {BEGIN} and {END}")
    before, after = page.split(BEGIN)[0], page.split(END)[1]
    return f"{before}{BEGIN}\n{text}{END}{after}"


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
    parser.add_argument("--jobs", type=int, help="processes (default: one a core)")
    parser.add_argument("--scheduler", help="address of a Dask cluster that does it instead")
    parser.add_argument("--classes", nargs="+", metavar="NAME", help=", ".join(item.name for item in CLASSES))
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="the first")
    parser.add_argument("--json", type=Path, help="where the numbers are written, record by record")
    parser.add_argument("--from", dest="earlier", nargs="+", type=Path, metavar="FILE", help="what --json has written")
    parser.add_argument("--write", action="store_true", help=f"write the tables into {PAGE.name}")
    return parser.parse_args()


if __name__ == "__main__":
    main()
