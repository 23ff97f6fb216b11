"""The catalogue of the reactor's effects. A new one: a file here, and a line below."""

from reactorwatch.process.effects.activation_energy import ActivationEnergy
from reactorwatch.process.effects.base import Effect
from reactorwatch.process.effects.bypass import Bypass
from reactorwatch.process.effects.concentration_bias import ConcentrationBias
from reactorwatch.process.effects.concentration_delay import ConcentrationDelay
from reactorwatch.process.effects.concentration_gain import ConcentrationGain
from reactorwatch.process.effects.coolant_flow import CoolantFlow
from reactorwatch.process.effects.coolant_temperature import CoolantTemperature
from reactorwatch.process.effects.feed_concentration import FeedConcentration
from reactorwatch.process.effects.feed_flow import FeedFlow
from reactorwatch.process.effects.feed_temperature import FeedTemperature
from reactorwatch.process.effects.heat_loss import HeatLoss
from reactorwatch.process.effects.heat_transfer import HeatTransfer
from reactorwatch.process.effects.jacket_lag import JacketLag
from reactorwatch.process.effects.reaction_heat import ReactionHeat
from reactorwatch.process.effects.reaction_order import ReactionOrder
from reactorwatch.process.effects.reaction_rate import ReactionRate
from reactorwatch.process.effects.sample_timing import SampleTiming
from reactorwatch.process.effects.side_reaction import SideReaction
from reactorwatch.process.effects.temperature_bias import TemperatureBias
from reactorwatch.process.effects.temperature_lag import TemperatureLag
from reactorwatch.process.effects.valve_lag import ValveLag
from reactorwatch.process.effects.valve_stiction import ValveStiction
from reactorwatch.process.effects.volume import Volume
from reactorwatch.process.effects.wall_heat_capacity import WallHeatCapacity

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
    JacketLag(),
    WallHeatCapacity(),
    ValveLag(),
    ValveStiction(),
    CoolantFlow(),
    TemperatureBias(),
    TemperatureLag(),
    ConcentrationBias(),
    ConcentrationGain(),
    ConcentrationDelay(),
    Bypass(),
    Volume(),
    SampleTiming(),
)
"""From the feed over the reaction and the cooling to the sensors, then what concerns several of them."""
