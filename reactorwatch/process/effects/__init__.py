"""The catalogue of the reactor's effects. A new one: a file here, and a line below."""

from reactorwatch.process.effects.activation_energy import ActivationEnergy
from reactorwatch.process.effects.base import Effect
from reactorwatch.process.effects.bypass import Bypass
from reactorwatch.process.effects.concentration_bias import ConcentrationBias
from reactorwatch.process.effects.concentration_gain import ConcentrationGain
from reactorwatch.process.effects.coolant_flow import CoolantFlow
from reactorwatch.process.effects.coolant_temperature import CoolantTemperature
from reactorwatch.process.effects.feed_concentration import FeedConcentration
from reactorwatch.process.effects.feed_flow import FeedFlow
from reactorwatch.process.effects.feed_temperature import FeedTemperature
from reactorwatch.process.effects.heat_loss import HeatLoss
from reactorwatch.process.effects.heat_transfer import HeatTransfer
from reactorwatch.process.effects.reaction_heat import ReactionHeat
from reactorwatch.process.effects.reaction_order import ReactionOrder
from reactorwatch.process.effects.reaction_rate import ReactionRate
from reactorwatch.process.effects.sample_timing import SampleTiming
from reactorwatch.process.effects.side_reaction import SideReaction
from reactorwatch.process.effects.temperature_bias import TemperatureBias
from reactorwatch.process.effects.volume import Volume

EFFECTS: tuple[Effect, ...] = (
    FeedTemperature(),
    FeedConcentration(),
    FeedFlow(),
    ReactionRate(),
    ActivationEnergy(),
    ReactionHeat(),
    SideReaction(),
    ReactionOrder(),
    HeatTransfer(),
    HeatLoss(),
    CoolantTemperature(),
    CoolantFlow(),
    TemperatureBias(),
    ConcentrationBias(),
    ConcentrationGain(),
    Bypass(),
    Volume(),
    SampleTiming(),
)
"""From the feed over the reaction and the cooling to the sensors, then what concerns several of them."""
