"""Diagnose plants with effects that are in no catalogue: verdict, place, law, gain and seconds of a core.

    python -m benchmarks.hidden.unlisted_study [--half tuned|judged] [--widths 3 8] [--first-seed 100]

Even effects of the list were used for tuning, odd ones were not.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from time import process_time

from benchmarks.hidden.unlisted import PLANTS, UNLISTED, Unlisted, draw_record
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.result import AMBIGUOUS, UNKNOWN, Diagnosis
from reactorwatch.process import MODELS

NEAR_FIRST, ENOUGH = 6.0, 1.05
"""Difference in BIC of a form from the first, and held-out error over the noise, that count as right."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of one record."""

    name: str
    verdict: str
    causes: tuple[str, ...]
    in_place: bool
    form: bool
    held_out: float
    seconds: float


def judge(effect: Unlisted, found: Diagnosis, seconds: float) -> Outcome:
    """Hold a diagnosis against the truth."""
    near = tuple(item.location for item in found.locations[:2])
    forms: set[str] = set()
    if found.law is not None:
        forms = {found.law.form, *(item.form for item in found.law.rivals if item.delta_bic < NEAR_FIRST)}
    last = found.gain.held_out[PLANTS[effect.process].outputs[-1]]
    return Outcome(
        effect.name,
        found.verdict,
        tuple(item.cause for item in found.causes),
        found.verdict in (UNKNOWN, AMBIGUOUS) and bool(set(near) & set(effect.places)),
        bool(forms & set(effect.forms)),
        last.rmse_after / last.noise_sd,
        seconds,
    )


def summarise(outcomes: Sequence[Outcome], with_law: Sequence[bool]) -> str:
    """Numbers of all records in a line."""
    n = len(outcomes)
    in_place, pairs = sum(item.in_place for item in outcomes), sum(len(item.causes) > 1 for item in outcomes)
    forms = sum(item.form for item, has in zip(outcomes, with_law, strict=True) if has)
    held = sum(item.held_out <= ENOUGH for item in outcomes)
    seconds = sorted(item.seconds for item in outcomes)
    return (
        f"{n} records: in place {in_place}, named as a pair {pairs}, form right {forms} of {sum(with_law)}, "
        f"held out {held}, seconds {seconds[n // 2]:.1f} / {seconds[-1]:.1f}"
    )


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--half", choices=("tuned", "judged"))
    parser.add_argument("--widths", type=float, nargs="+", default=[3.0, 8.0])
    parser.add_argument("--first-seed", type=int, default=100)
    options = parser.parse_args()
    outcomes, with_law = [], []
    models = {make().name: make() for make in MODELS}
    for index, effect in enumerate(UNLISTED):
        if options.half and (options.half == "judged") != bool(index % 2):
            continue
        for widths in options.widths:
            record = draw_record(effect, options.first_seed + index, widths).record
            begin = process_time()
            found = diagnose(record, models[effect.process])
            outcome = judge(effect, found, process_time() - begin)
            outcomes.append(outcome)
            with_law.append(bool(effect.forms))
            law = "" if found.law is None else f"; {found.law.formula}"
            print(f"{outcome}{law}", flush=True)
    print(summarise(outcomes, with_law))


if __name__ == "__main__":
    main()
