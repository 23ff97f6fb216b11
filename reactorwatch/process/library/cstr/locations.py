"""Locations of effects on the reactor, with their phrases."""

from reactorwatch.process.effect import TIMING

LOCATIONS = {
    "mass_balance": "in the mass balance",
    "energy_balance": "in the energy balance",
    "reaction": "in the reaction",
    "feed": "in the feed",
    "coolant": "on the side of the coolant",
    "temperature_sensor": "in the measurement of the temperature",
    "concentration_sensor": "in the measurement of the concentration",
    TIMING: "in the times of the record",
}
