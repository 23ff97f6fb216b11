"""The causes that an alarm is traced to.

Not the whole catalogue. What is compared within tenths of a second, at a few rows after an alarm, is what sets in on a
running plant and shows at once: the flows, temperatures and concentrations that come in, the reaction, the cooling, and
the sensors. Lags, delays and a wrong volume, order or timing are there from the first row on, so the filter that the
monitor was trained with has taken them in; some bring states of their own, from which there is no infinitesimal
deviation; and each cause that another imitates takes probability from it. Those are for a diagnosis of the record.
"""

from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr.effects import EFFECTS

NAMES = (
    "feed_temperature",
    "feed_concentration",
    "feed_flow",
    "reaction_rate",
    "activation_energy",
    "reaction_heat",
    "heat_transfer",
    "heat_loss",
    "coolant_temperature",
    "coolant_flow",
    "temperature_bias",
    "concentration_bias",
    "concentration_gain",
)

CAUSES: tuple[Effect, ...] = tuple(effect for effect in EFFECTS if effect.name in NAMES)
"""In the order of the catalogue."""
