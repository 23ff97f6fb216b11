"""The catalogue of the tanks' effects. A new one: a file here, and a line below."""

from reactorwatch.process.effects.base import Effect
from reactorwatch.process.tank_effects.level_bias import LevelBias
from reactorwatch.process.tank_effects.outlet_clogging import OutletClogging
from reactorwatch.process.tank_effects.overflow import Overflow
from reactorwatch.process.tank_effects.pump_gain import PumpGain
from reactorwatch.process.tank_effects.upper_leak import UpperLeak

TANK_EFFECTS: tuple[Effect, ...] = (
    PumpGain(),
    UpperLeak(),
    OutletClogging(),
    Overflow(),
    LevelBias(),
)
"""From the pump downwards to the sensor."""
