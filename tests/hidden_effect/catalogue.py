"""Effects that are hidden, their sizes and profiles; and the locations of those in no catalogue.

`smallest` is about the least that is worth finding: with the input stepping widely (`excitation.py`), 0.3 K or 0.002
mol/l on average over the record, as much as the noise of an ordinary thermometer or analyser. `largest` is ten times
that, or where the reactor starts to leave its branch.
"""

from dataclasses import dataclass

from reactorwatch.process.library.cstr import EFFECTS, cstr
from tests.hidden_effect import reactor

BOTH, UP, DOWN = (1.0, -1.0), (1.0,), (-1.0,)
ALL = ("constant", "step", "ramp", "decay", "sine", "free")
ONE_SIDED = ("constant", "step", "ramp", "decay", "free")
"""What cannot be negative does not swing about zero."""
LASTING = ("constant", "step")
BY_ITSELF = ("constant",)


@dataclass(frozen=True)
class HiddenEffect:
    """An effect that may be hidden.

    Attributes:
        name: in the catalogue, or outside of it.
        places: where it acts; of one outside of every catalogue all that are right, the best first.
        smallest: size.
        largest: size.
        signs: of the size.
        courses: kinds that it may have.
    """

    name: str
    places: tuple[str, ...]
    smallest: float
    largest: float
    signs: tuple[float, ...] = BOTH
    courses: tuple[str, ...] = ALL


CATALOGUE = (
    HiddenEffect("feed_temperature", ("feed",), 0.3, 3.0),
    HiddenEffect("feed_concentration", ("feed",), 0.002, 0.03),
    HiddenEffect("feed_flow", ("feed",), 0.004, 0.05),
    HiddenEffect("reaction_rate", ("reaction",), 0.01, 0.2),
    HiddenEffect("activation_energy", ("reaction",), 0.0005, 0.01),
    HiddenEffect("reaction_heat", ("reaction",), 0.002, 0.03),
    HiddenEffect("side_reaction", ("reaction",), 0.04, 0.5, UP, ONE_SIDED),
    HiddenEffect("reaction_order", ("reaction",), 0.025, 0.3),
    HiddenEffect("heat_transfer", ("coolant",), 0.2, 0.6, DOWN, ONE_SIDED),
    HiddenEffect("heat_loss", ("energy_balance",), 0.002, 0.02, UP, ONE_SIDED),
    HiddenEffect("coolant_temperature", ("coolant",), 0.3, 3.0),
    HiddenEffect("jacket_lag", ("coolant",), 0.02, 0.1, UP, ONE_SIDED),
    HiddenEffect("wall_heat_capacity", ("energy_balance",), 0.03, 0.5, UP, LASTING),
    HiddenEffect("valve_lag", ("coolant",), 0.03, 0.5, UP, ONE_SIDED),
    HiddenEffect("valve_stiction", ("coolant",), 1.5, 8.0, UP, LASTING),
    HiddenEffect("coolant_flow", ("coolant",), 0.003, 0.03),
    HiddenEffect("temperature_bias", ("temperature_sensor",), 0.3, 5.0),
    HiddenEffect("temperature_lag", ("temperature_sensor",), 0.03, 0.5, UP, ONE_SIDED),
    HiddenEffect("concentration_bias", ("concentration_sensor",), 0.002, 0.03),
    HiddenEffect("concentration_gain", ("concentration_sensor",), 0.02, 0.3),
    HiddenEffect("concentration_delay", ("concentration_sensor",), 0.04, 1.0, UP, ONE_SIDED),
    HiddenEffect("bypass", ("feed",), 0.002, 0.02, UP, ONE_SIDED),
    HiddenEffect("volume", ("mass_balance",), 0.01, 0.2),
    HiddenEffect("sample_timing", ("timing",), 0.03, 0.1, UP, LASTING),
)

OUTSIDE = (
    HiddenEffect("inhibited_when_hot", ("reaction",), 0.1, 1.0, UP, BY_ITSELF),
    HiddenEffect("substrate_inhibition", ("reaction",), 0.004, 0.02, BOTH, BY_ITSELF),
    HiddenEffect("curved_valve", ("coolant",), 0.006, 0.06, BOTH, BY_ITSELF),
    HiddenEffect("valve_backlash", ("coolant",), 1.0, 6.0, UP, BY_ITSELF),
    HiddenEffect("boiling", ("energy_balance",), 0.15, 1.5, UP, BY_ITSELF),
    HiddenEffect("random_heat", ("energy_balance", "feed", "coolant"), 1.0, 4.0, UP, ("free",)),
    HiddenEffect("bowed_thermometer", ("temperature_sensor",), 0.7, 4.0, BOTH, BY_ITSELF),
    HiddenEffect("thermometer_hysteresis", ("temperature_sensor",), 0.8, 4.0, UP, BY_ITSELF),
    HiddenEffect("analyser_saturation", ("concentration_sensor",), 0.2, 0.8, UP, BY_ITSELF),
    HiddenEffect("dilution_pulses", ("mass_balance",), 0.02, 0.08, UP, ("pulses",)),
    HiddenEffect("feed_pulses", ("feed",), 0.003, 0.02, BOTH, ("pulses",)),
)
"""What heats at random acts on the energy balance whichever way it comes in: by the feed, by the coolant."""

_OPEN = {"side_reaction.E2": 15e3, "side_reaction.heat": 100.0, "wall_heat_capacity.exchange": 2.0}
"""Where the catalogue leaves a constant open and the software has no such effect (yet)."""


def named() -> tuple[HiddenEffect, ...]:
    """Effects of the catalogue that the software has."""
    known = {effect.name for effect in EFFECTS}
    return tuple(item for item in CATALOGUE if item.name in known)


def open_constants() -> tuple[float, float, float]:
    """E2 in K and heat in K l/mol of the side reaction, exchange of the wall in 1/min: as the software has chosen."""
    found = dict(_OPEN)
    for effect in EFFECTS:
        if effect.name in ("side_reaction", "wall_heat_capacity"):
            extended = effect.extend(cstr())
            chosen = {item.name: item.value for item in extended.parameters}
            found |= {name: chosen[name] for name in found if name in chosen}
    return found["side_reaction.E2"], found["side_reaction.heat"], found["wall_heat_capacity.exchange"]


assert tuple(item.name for item in CATALOGUE) == reactor.CATALOGUE
assert tuple(item.name for item in OUTSIDE) == reactor.OUTSIDE
