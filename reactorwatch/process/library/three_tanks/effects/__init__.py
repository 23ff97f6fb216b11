"""The catalogue of the three tanks' effects. A new one: a file here, and a line below."""

from reactorwatch.process.effect import Effect
from reactorwatch.process.library.three_tanks.effects.clogging import CLOGGINGS
from reactorwatch.process.library.three_tanks.effects.leak import LEAKS
from reactorwatch.process.library.three_tanks.effects.level_bias import LEVEL_BIASES
from reactorwatch.process.library.three_tanks.effects.pump_flow import PUMP_FLOWS

THREE_TANKS_EFFECTS: tuple[Effect, ...] = (*PUMP_FLOWS, *LEVEL_BIASES, *LEAKS, *CLOGGINGS)
"""Pumps, sensors, tanks, pipes."""
