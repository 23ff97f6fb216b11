"""The classes of records that the diagnosis is held to, and how the records of each are drawn."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from tests.hidden_effect.catalogue import OUTSIDE, HiddenEffect, named
from tests.hidden_effect.draw import CannotHideError, Hidden, draw
from tests.hidden_effect.excitation import (
    MEDIUM_PROCESS_NOISE,
    NAMED_CIRCUMSTANCES,
    SMALL_PROCESS_NOISE,
    Circumstances,
)

SEEDS_A_CLASS = 100_000

NEARLY, BACKGROUND = "not quite the model", 0.2
"""Class of plants that differ from the model beside what is hidden, and by which share of what is worth finding."""


@dataclass(frozen=True)
class StudyClass:
    """A class of records."""

    name: str  # name of the class
    kind: str  # kind of the score, `single`, `pair`, `nominal` or `outside`
    circumstances: Callable[[int], Circumstances]  # function of the number of a record that returns its circumstances
    group: str = ""  # classes of one group are scored together as well; empty: none


def _always(circumstances: Circumstances) -> Callable[[int], Circumstances]:
    return lambda number: circumstances


def _in_turn(*circumstances: Circumstances) -> Callable[[int], Circumstances]:
    return lambda number: circumstances[number % len(circumstances)]


_MEDIUM = NAMED_CIRCUMSTANCES["medium"]
_QUIET = _in_turn(
    _MEDIUM,
    replace(_MEDIUM, process_sd=SMALL_PROCESS_NOISE),
    NAMED_CIRCUMSTANCES["closed loop"],
    replace(_MEDIUM, process_sd=MEDIUM_PROCESS_NOISE),
    NAMED_CIRCUMSTANCES["narrow"],
    replace(NAMED_CIRCUMSTANCES["closed loop"], process_sd=SMALL_PROCESS_NOISE),
    NAMED_CIRCUMSTANCES["few steps"],
    NAMED_CIRCUMSTANCES["missing rows"],
    NAMED_CIRCUMSTANCES["150 min"],
    NAMED_CIRCUMSTANCES["low noise"],
    NAMED_CIRCUMSTANCES["high noise"],
)
_HARD_QUIET = _in_turn(
    *(
        NAMED_CIRCUMSTANCES[name]
        for name in ("correlated noise", "irregular", "quantised", "outliers", "wrong branch", "extinguished")
    )
)

_LESS_GENTLE = ("closed loop", "missing rows", "150 min")
_HARD = (
    "process noise",
    "more process noise",
    "correlated noise",
    "irregular",
    "quantised",
    "outliers",
    "wrong branch",
    "extinguished",
)

CLASSES: tuple[StudyClass, ...] = (
    StudyClass("nominal", "nominal", _QUIET),
    StudyClass("medium", "single", _always(_MEDIUM)),
    StudyClass("narrow", "single", _always(NAMED_CIRCUMSTANCES["narrow"])),
    *(StudyClass(name, "single", _always(NAMED_CIRCUMSTANCES[name]), ", ".join(_LESS_GENTLE)) for name in _LESS_GENTLE),
    StudyClass("pairs", "pair", _always(_MEDIUM)),
    StudyClass("outside", "outside", _always(_MEDIUM)),
    StudyClass("low noise", "single", _always(NAMED_CIRCUMSTANCES["low noise"])),
    StudyClass("high noise", "single", _always(NAMED_CIRCUMSTANCES["high noise"])),
    StudyClass("few steps", "single", _always(NAMED_CIRCUMSTANCES["few steps"])),
    *(StudyClass(name, "single", _always(NAMED_CIRCUMSTANCES[name])) for name in _HARD),
    StudyClass("hard nominal", "nominal", _HARD_QUIET),
    StudyClass("missing values", "single", _always(NAMED_CIRCUMSTANCES["missing values"])),
    StudyClass(NEARLY, "single", _always(replace(_MEDIUM, background=BACKGROUND))),
)
"""The seeds of a class follow from its place: a new one goes to the end."""


def find_class(name: str) -> StudyClass:
    """Find a class by its name."""
    for item in CLASSES:
        if item.name == name:
            return item
    raise KeyError(f"no class {name!r} (valid: {', '.join(item.name for item in CLASSES)})")


def seed_of(study_class: StudyClass, number: int, first_seed: int) -> int:
    """The seed of a record of a class."""
    return first_seed + SEEDS_A_CLASS * CLASSES.index(study_class) + number


def draw_record(study_class: StudyClass, number: int, first_seed: int) -> Hidden:
    """Draw a record of a class. Causes take turns, so that each occurs as often; one that cannot show gives way."""
    seed = seed_of(study_class, number, first_seed)
    circumstances = study_class.circumstances(number)
    if study_class.kind == "nominal":
        return draw(seed, (), circumstances)
    for turn in range(100):
        effects = _effects(study_class, number, first_seed, turn)
        try:
            return draw(seed, effects, circumstances)
        except CannotHideError:
            continue
    raise CannotHideError(f"seed {seed}: nothing can be hidden under {circumstances}")


def _effects(study_class: StudyClass, number: int, first_seed: int, turn: int) -> Sequence[HiddenEffect]:
    key = [first_seed, CLASSES.index(study_class)]
    if study_class.kind == "pair":
        pairs = list(combinations(named(), 2))
        order = np.random.default_rng(key).permutation(len(pairs))
        return pairs[int(order[(number + turn * len(CLASSES)) % len(pairs)])]
    known = OUTSIDE if study_class.kind == "outside" else named()
    order = np.random.default_rng([*key, number // len(known)]).permutation(len(known))
    return (known[int(order[(number + turn) % len(known)])],)
