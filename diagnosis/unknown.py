"""What no cause of the catalogue explains, but acts somewhere.

An unknown effect at a place is one of the catalogue's effects there whose size is no course in time but any smooth
function of where the plant is: of a few low powers of states and inputs, and of a free curve. Which of these terms it
needs is selected forwards, by BIC, on the linear equations of the filter's errors, and what was selected is fitted like
any other hypothesis. So an unknown is compared with the catalogue by the same likelihood; as it may bend more, it has
to be better by `MARGIN`. It can be located, and what it does in this record described; it is no model for another day.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import log

import numpy as np

from diagnosis import signatures
from diagnosis.courses import Course, Free, Signal
from diagnosis.hypothesis import Hypothesis
from diagnosis.run import Run
from diagnosis.search import Explained, Search
from reactorwatch.process.effects.base import Effect
from reactorwatch.process.model import Array

MARGIN = 25.0
"""In BIC, over the best of the catalogue."""

MOST_TERMS = 6
LEAST_TERM_GAIN = 6.0
"""In BIC, of a further term."""

KNOTS, POWERS = 8, 2
PLACES = 3
"""How many of the most promising carriers are fitted."""

ROUNDS = 3


class Terms(Course):
    """A sum of given signals.

    Args:
        time_min: of the rows.
        signals: of the terms, shape (rows, terms).
        labels: of the terms.
    """

    name = "terms"

    def __init__(self, time_min: Array, signals: Signal, labels: Sequence[str]) -> None:
        super().__init__(time_min)
        self._signals, self.labels = signals, tuple(labels)
        self.coefficients = len(self.labels)

    def functions(self, shape: Array) -> tuple[Array, Array]:
        """See `Course`."""
        area = np.cumsum(self._signals.over_row[:-1] * np.diff(self.time_min)[:, None], axis=0)
        return self._signals.at_row, np.concatenate([np.zeros((1, self.coefficients)), area])

    def parameters(self, theta: Array) -> dict[str, float]:
        """See `Course`. The size is the root mean square."""
        signal = self.signal(theta)
        found = {"size": float(np.sqrt(np.mean(signal.at_row**2)))}
        return found | dict(zip(self.labels, theta.tolist(), strict=True))

    def _coefficients_limited(self, by: Array, lower: float, upper: float) -> Array:
        return by


@dataclass(frozen=True, eq=False)
class _Selection:
    """The terms that an unknown effect at the place of a catalogue's effect needs."""

    effect: Effect
    course: Terms
    theta: Array
    score: float


def unknown(search: Search, best: Explained, effects: Sequence[Effect]) -> Explained | None:
    """The best unknown effect, if it explains the run better than the best of the catalogue by `MARGIN`.

    Args:
        search: of the run.
        best: of the catalogue, or the nominal one; with the noise that it needs.
        effects: the catalogue.
    """
    found: Explained | None = None
    from_here = search.nominal()
    for _ in range(ROUNDS):
        chosen = _selected(search, from_here, effects)[:PLACES]
        fits = [search.fit(Hypothesis(search.sized((item.effect,)), (item.course,)), (item.theta,)) for item in chosen]
        if found is not None:
            fits.append(search.refitted(found))
        if not fits:
            break
        again, found = found, min(fits, key=lambda item: item.bic)
        if again is not None and found.hypothesis is again.hypothesis:
            break
        search.settle(found)
        from_here = found = search.refitted(found)
    return found if found is not None and found.bic < best.bic - MARGIN else None


def _selected(search: Search, about: Explained, effects: Sequence[Effect]) -> list[_Selection]:
    """For each carrier the terms that explain most, the most promising first."""
    run, screen = search.run, search.screen
    library, labels = _library(run, about)
    found = []
    with np.errstate(over="ignore", invalid="ignore"):
        ways = screen.ways_of_all(about.hypothesis, about.fit, replaced=range(len(about.hypothesis.courses)))
        for place, effect in enumerate(screen.direct):
            if effect not in effects:
                continue
            g = signatures.shown(ways, place, library.over_row[1:-1], library.at_row[2:])
            g = g.reshape(-1, len(labels))
            picked, theta, gain = _forwards(g.T @ g, g.T @ ways.w.ravel(), log(run.values))
            if picked:
                signals = Signal(library.over_row[:, picked], library.at_row[:, picked])
                course = Terms(run.time_min, signals, [labels[item] for item in picked])
                found.append(_Selection(effect, course, theta, gain - len(picked) * log(run.values)))
    return sorted(found, key=lambda item: -item.score)


def _forwards(gram: Array, by: Array, price: float) -> tuple[list[int], Array, float]:
    """Terms, each of which gains the most that is left; their coefficients; twice the gain in log likelihood."""
    picked: list[int] = []
    theta, gain = np.empty(0), 0.0
    if not (np.all(np.isfinite(gram)) and np.all(np.isfinite(by))):
        return picked, theta, gain
    while len(picked) < MOST_TERMS:
        best, best_gain = -1, gain + price + LEAST_TERM_GAIN
        for term in range(by.size):
            if term not in picked:
                chosen = [*picked, term]
                a = by[chosen]
                value = float(a @ np.linalg.lstsq(gram[np.ix_(chosen, chosen)], a, rcond=1e-10)[0])
                if value > best_gain:
                    best, best_gain = term, value
        if best < 0:
            break
        picked.append(best)
        gain = best_gain
        theta = np.asarray(np.linalg.lstsq(gram[np.ix_(picked, picked)], by[picked], rcond=1e-10)[0])
    return picked, theta, gain


def _library(run: Run, about: Explained) -> tuple[Signal, list[str]]:
    """Powers of states and inputs up to `POWERS`, each about its mean and in its standard deviations, and hats."""
    states = about.hypothesis.sized.model.state_names[: about.hypothesis.sized.own_states]
    x = about.fit.found.x[:, : len(states)]
    x = np.where(np.isfinite(x), x, np.nanmean(x, axis=0))
    z, labels = _scaled(np.column_stack([x, run.inputs])), [*states, *(f"u{i}" for i in range(run.inputs.shape[1]))]
    after = np.vstack([z[1:], z[-1:]])
    after[:, len(states) :] = z[:, len(states) :]  # inputs are held
    columns, names = [(np.ones(len(z)), np.ones(len(z)))], ["1"]
    for power in range(1, POWERS + 1):
        for chosen in combinations_with_replacement(range(z.shape[1]), power):
            now, then = np.prod(z[:, chosen], axis=1), np.prod(after[:, chosen], axis=1)
            columns.append((0.5 * (now + then), now))
            names.append("*".join(labels[item] for item in chosen))
    hats = Free(run.time_min, KNOTS).basis(np.empty(0))
    over_row = np.column_stack([*(item[0] for item in columns), hats.over_row[:, 1:]])
    at_row = np.column_stack([*(item[1] for item in columns), hats.at_row[:, 1:]])
    return Signal(over_row, at_row), [*names, *(f"knot {number}" for number in range(2, KNOTS + 1))]


def _scaled(values: Array) -> Array:
    spread = np.std(values, axis=0)
    return np.asarray((values - np.mean(values, axis=0)) / np.where(spread > 0.0, spread, 1.0))
