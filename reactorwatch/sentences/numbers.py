"""Numbers in words: estimates with their intervals, errors, shares and odds."""

from math import e, exp, floor, isfinite, log10
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from reactorwatch.diagnosis.result import Estimate


def format_interval(estimate: "Estimate") -> str:
    """Estimate and half width of its 95 % interval, with the unit.

    >>> from reactorwatch.diagnosis.result import Estimate
    >>> format_interval(Estimate(-0.0499634, 8.5e-5, "1"))
    '-0.04996 ± 0.00017'
    >>> format_interval(Estimate(299.9, 0.0, "min"))
    '299.9 min'
    """
    unit = "" if estimate.unit == "1" else f" {estimate.unit}"
    value, half = round_estimate(estimate)
    return f"{value} ± {half}{unit}" if half else f"{value}{unit}"


def round_estimate(estimate: "Estimate") -> tuple[str, str]:
    """Estimate and half width of its 95 % interval with equal decimals; the latter empty if it is not known.

    The interval has one digit, or two if it begins with a 1.

    >>> from reactorwatch.diagnosis.result import Estimate
    >>> round_estimate(Estimate(14.998, 0.0127, "%"))
    ('15.00', '0.02')
    """
    half = estimate.half_width
    if not (isfinite(half) and half > 0.0):
        return f"{estimate.value:.5g}", ""
    first = floor(log10(half))
    decimals = -first + (half < 2.0 * 10.0**first)
    if decimals < 0:
        return f"{round(estimate.value, decimals):.0f}", f"{round(half, decimals):.0f}"
    return f"{estimate.value:.{decimals}f}", f"{half:.{decimals}f}"


def format_error(value: float, unit: str) -> str:
    """Root mean square error; none if the simulation diverged."""
    return f"{value:.3g} {unit}" if isfinite(value) else "none, it ran away"


def percent(share: float) -> str:
    """A share or a probability in per cent.

    >>> percent(0.9997), percent(0.354)
    ('more than 99 %', '35 %')
    """
    if share < 0.01:
        return "less than 1 %"
    return "more than 99 %" if share > 0.99 else f"{100.0 * share:.0f} %"


def odds(delta_bic: float) -> str:
    """Odds of two hypotheses by their difference in BIC, equal before the record.

    >>> odds(4.5), odds(10.0), odds(2782.9)
    ('9.5 to 1', '150 to 1', '10^604 to 1')
    """
    exponent = 0.5 * delta_bic * log10(e)
    return f"{float(f'{exp(0.5 * delta_bic):.2g}'):g} to 1" if exponent < 3.0 else f"10^{exponent:.0f} to 1"
