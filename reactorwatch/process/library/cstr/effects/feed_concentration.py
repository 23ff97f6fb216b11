"""Deviation of the feed concentration."""

from reactorwatch.process.effect import ParameterShift


class FeedConcentration(ParameterShift):
    """Cf + m."""

    name = "feed_concentration"
    label = "wrong feed concentration"
    location = "feed"
    unit = "mol/l"
    larger = "feed richer in A by {} mol/l"
    smaller = "feed poorer in A by {} mol/l"
    lower = -1.0
    upper = 1.0
    typical = 0.01
    parameter = "Cf"
