"""Causes to which an alarm is traced: of a process of the catalogue, its own effects.

Those of the reactor are not the whole catalogue. Causes are compared within tenths of a second at a few rows after an
alarm, so these are the ones that occur on a running plant and act at once: the flows, temperatures and concentrations
of the feeds, the reaction, the cooling, and the sensors. Lags, delays and a wrong volume, order or timing act from the
first row on, so the filter of the training has adapted to them; some add states of their own, from which there is no
infinitesimal deviation; and each cause that another imitates takes probability from it. Those are left to a diagnosis
of the record.
"""

from reactorwatch.process import EFFECTS_OF
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr.effects import EFFECTS
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.process.model import ProcessModel

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
"""Causes of the reactor in the order of the catalogue."""


def causes_of(model: ProcessModel) -> tuple[Effect, ...]:
    """Causes to which alarms of a plant with these equations are traced; empty if the catalogue has none."""
    return CAUSES if model.name == cstr().name else EFFECTS_OF.get(model.name, ())
