"""The catalogue of the three tanks' effects. A new one: a class in a file here, and a line below."""

from reactorwatch.process.effect import Effect
from reactorwatch.process.library.three_tanks.effects.clogging import Clogging13, Clogging20, Clogging32
from reactorwatch.process.library.three_tanks.effects.leak import Leak1, Leak2, Leak3
from reactorwatch.process.library.three_tanks.effects.level_bias import Level1Bias, Level2Bias, Level3Bias
from reactorwatch.process.library.three_tanks.effects.pump_flow import Pump1, Pump2

THREE_TANKS_EFFECTS: tuple[Effect, ...] = (
    Pump1(),
    Pump2(),
    Level1Bias(),
    Level2Bias(),
    Level3Bias(),
    Leak1(),
    Leak2(),
    Leak3(),
    Clogging13(),
    Clogging20(),
    Clogging32(),
)
"""Pumps, sensors, tanks, pipes."""
