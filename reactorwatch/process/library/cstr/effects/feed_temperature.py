"""Deviation of the feed temperature."""

from reactorwatch.process.effect import ParameterShift


class FeedTemperature(ParameterShift):
    """Tf + m."""

    name = "feed_temperature"
    label = "wrong feed temperature"
    location = "feed"
    unit = "K"
    larger = "feed warmer by {} K"
    smaller = "feed colder by {} K"
    lower = -50.0
    upper = 50.0
    typical = 2.0
    parameter = "Tf"
