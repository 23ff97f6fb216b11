"""The catalogue of the reactor's effects. A new one: a file here, and a line below.

The monitor compares causes within tenths of a second at a few rows after an alarm, so it traces (`Effect.is_traced`)
those that occur on a running plant and act at once: the flows, temperatures and concentrations of the feeds, the
reaction, the cooling, and the sensors. Lags, delays and a wrong volume, order or timing act from the first row on, so
the filter of the training has adapted to them; and each cause that another imitates takes probability from it. Those
are left to a diagnosis of the record.
"""

from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr.effects.activation_energy import ActivationEnergy
from reactorwatch.process.library.cstr.effects.bypass import Bypass
from reactorwatch.process.library.cstr.effects.concentration_bias import ConcentrationBias
from reactorwatch.process.library.cstr.effects.concentration_delay import ConcentrationDelay
from reactorwatch.process.library.cstr.effects.concentration_gain import ConcentrationGain
from reactorwatch.process.library.cstr.effects.coolant_flow import CoolantFlow
from reactorwatch.process.library.cstr.effects.coolant_temperature import CoolantTemperature
from reactorwatch.process.library.cstr.effects.feed_concentration import FeedConcentration
from reactorwatch.process.library.cstr.effects.feed_flow import FeedFlow
from reactorwatch.process.library.cstr.effects.feed_temperature import FeedTemperature
from reactorwatch.process.library.cstr.effects.heat_loss import HeatLoss
from reactorwatch.process.library.cstr.effects.heat_transfer import HeatTransfer
from reactorwatch.process.library.cstr.effects.jacket_lag import JacketLag
from reactorwatch.process.library.cstr.effects.reaction_heat import ReactionHeat
from reactorwatch.process.library.cstr.effects.reaction_order import ReactionOrder
from reactorwatch.process.library.cstr.effects.reaction_rate import ReactionRate
from reactorwatch.process.library.cstr.effects.sample_timing import SampleTiming
from reactorwatch.process.library.cstr.effects.side_reaction import SideReaction
from reactorwatch.process.library.cstr.effects.temperature_bias import TemperatureBias
from reactorwatch.process.library.cstr.effects.temperature_lag import TemperatureLag
from reactorwatch.process.library.cstr.effects.valve_lag import ValveLag
from reactorwatch.process.library.cstr.effects.valve_stiction import ValveStiction
from reactorwatch.process.library.cstr.effects.volume import Volume
from reactorwatch.process.library.cstr.effects.wall_heat_capacity import WallHeatCapacity

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
"""Effects in the order feed, reaction, cooling, sensors, then effects on several of them."""
