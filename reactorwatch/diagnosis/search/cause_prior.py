"""Prior probabilities of hypotheses, as costs in BIC (docs/decisions/0014-two-causes.md).

Of n possible causes each is there from the beginning with the probability 1/n, so that one is expected, and a cause
that nothing in the catalogue describes is as likely in each location as one of the catalogue. So two independent causes
that are both there from the beginning have 1/n of the prior odds of one, known or not: a cost of 2 log n. Causes that
set in later are not charged for it: one may follow from the other, and a time of its own is evidence of each.
"""

from math import log

from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis

SOURCE_COST = 6.0
"""Cost in BIC of an unmodelled source, odds of twenty to one: a cause with a name has to be worse by more, before it
counts as unknown."""

FROM_BEGINNING = frozenset(("constant", "sine", "free"))
"""Profiles without an onset."""


def prior_cost(hypothesis: Hypothesis, n_causes: int) -> float:
    """Minus twice the logarithm of the prior odds of a hypothesis against a single named cause, of so many possible."""
    effects, profiles = hypothesis.filter.effects, hypothesis.profiles
    result = SOURCE_COST * sum(effect.is_source for effect in effects)
    if len(effects) > 1 and all(profile.name in FROM_BEGINNING for profile in profiles):
        result += 2.0 * log(n_causes)
    return result
