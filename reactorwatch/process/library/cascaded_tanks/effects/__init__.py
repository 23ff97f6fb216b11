"""The catalogue of the tanks' effects. A new one: a file here, and a line below."""

from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cascaded_tanks.effects.level_bias import LevelBias
from reactorwatch.process.library.cascaded_tanks.effects.lower_outlet import LowerOutlet
from reactorwatch.process.library.cascaded_tanks.effects.lower_overflow import LowerOverflow
from reactorwatch.process.library.cascaded_tanks.effects.outlet_clogging import OutletClogging
from reactorwatch.process.library.cascaded_tanks.effects.overflow import Overflow
from reactorwatch.process.library.cascaded_tanks.effects.pump_gain import PumpGain
from reactorwatch.process.library.cascaded_tanks.effects.upper_leak import UpperLeak

TANK_EFFECTS: tuple[Effect, ...] = (
    PumpGain(),
    UpperLeak(),
    OutletClogging(),
    Overflow(),
    LowerOverflow(),
    LowerOutlet(),
    LevelBias(),
)
"""Effects in the order of the flow, from the pump to the sensor."""
