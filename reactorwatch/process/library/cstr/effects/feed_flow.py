"""Deviation of the feed flow."""

from reactorwatch.process.effect import ParameterEffect


class FeedFlow(ParameterEffect):
    """q (1 + m). At constant volume the outflow is equal; with level control the level responds."""

    name = "feed_flow"
    label = "wrong feed flow"
    location = "feed"
    larger = "{} % more feed"
    smaller = "{} % less feed"
    typical = 0.03
    parameter = "q"
