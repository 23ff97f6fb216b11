"""The reactor with everything that may be wrong with it, written out by hand, without anything of `reactorwatch`.

State x = (C, T, Tw, D, F, W): concentration and temperature, temperature of the wall, cooling duty, flow behind a slow
valve, temperature in the thermowell. Deviations are numbers m, one an effect, all neutral at 0:

    dC/dt  = q/V (Cf - C) - r - s
    dT/dt  = q/V (Tf - T) + 200 (1 + m) r + h s + D - m (T - 298) - m rw (T - Tw)
    r = k0 (1 + m) exp(-E/R (1 + m) / T) C (C / 0.1)^m,    s = m exp(-E2 (1/T - 1/438.54)) C
    D follows K2 F (1 - exp(-K3 / F)) (Tcf - T), F follows the valve times (1 + m), Tw follows T, W follows T

Each m is that of the effect that its place in the equation belongs to. Then come effects that are in no catalogue.
"""

from math import exp

from reactorwatch.codegen.numba_kernel import jit
from tests.hidden_effect.courses import Array

CATALOGUE = (
    "feed_temperature",
    "feed_concentration",
    "feed_flow",
    "reaction_rate",
    "activation_energy",
    "reaction_heat",
    "side_reaction",
    "reaction_order",
    "heat_transfer",
    "heat_loss",
    "coolant_temperature",
    "jacket_lag",
    "wall_heat_capacity",
    "valve_lag",
    "valve_stiction",
    "coolant_flow",
    "temperature_bias",
    "temperature_lag",
    "concentration_bias",
    "concentration_gain",
    "concentration_delay",
    "bypass",
    "volume",
    "sample_timing",
)
(
    FEED_TEMPERATURE,
    FEED_CONCENTRATION,
    FEED_FLOW,
    REACTION_RATE,
    ACTIVATION_ENERGY,
    REACTION_HEAT,
    SIDE_REACTION,
    REACTION_ORDER,
    HEAT_TRANSFER,
    HEAT_LOSS,
    COOLANT_TEMPERATURE,
    JACKET_LAG,
    WALL_HEAT_CAPACITY,
    VALVE_LAG,
    VALVE_STICTION,
    COOLANT_FLOW,
    TEMPERATURE_BIAS,
    TEMPERATURE_LAG,
    CONCENTRATION_BIAS,
    CONCENTRATION_GAIN,
    CONCENTRATION_DELAY,
    BYPASS,
    VOLUME,
    SAMPLE_TIMING,
) = range(24)

OUTSIDE = (
    "inhibited_when_hot",
    "substrate_inhibition",
    "curved_valve",
    "valve_backlash",
    "boiling",
    "random_heat",
    "bowed_thermometer",
    "thermometer_hysteresis",
    "analyser_saturation",
    "dilution_pulses",
    "feed_pulses",
)
(
    INHIBITED_WHEN_HOT,
    SUBSTRATE_INHIBITION,
    CURVED_VALVE,
    VALVE_BACKLASH,
    BOILING,
    RANDOM_HEAT,
    BOWED_THERMOMETER,
    THERMOMETER_HYSTERESIS,
    ANALYSER_SATURATION,
    DILUTION_PULSES,
    FEED_PULSES,
) = range(24, 35)
"""Effects in no catalogue: see where each stands in the functions below."""

EFFECTS = CATALOGUE + OUTSIDE

C_, T_, WALL, DUTY, FLOW, WELL = range(6)
STATES = 6
SIDE_ACTIVATION, SIDE_HEAT, WALL_EXCHANGE = range(3)
"""Constants that the catalogue leaves open: E2 in K, h in K l/mol, rw in 1/min."""

HOT_K, HIGH_MOL_L = 440.0, 0.105
"""Where the effects that set in at a threshold do so: in the middle of what the reactor goes through."""

LEAST_LAG_MIN = 5e-4
"""A shorter one is none."""


@jit
def duty_of(T: float, flow: float, m: Array) -> float:
    """The cooling duty at rest, K/min."""
    flow = max(flow, 1e-6)
    cooling = 0.01 / (1.0 + m[VOLUME]) * flow * (1.0 - exp(-700.0 * (1.0 + m[HEAT_TRANSFER]) / flow))
    return float(cooling * (350.0 + m[COOLANT_TEMPERATURE] - T))


@jit
def flow_of(valve: float, m: Array) -> float:
    """Flow through the valve at its position, l/min."""
    return float(valve * (1.0 + m[COOLANT_FLOW]) * (1.0 + m[CURVED_VALVE] * ((valve - 100.0) / 10.0) ** 2))


@jit
def outlet_of(inside: float, feed: float, m: Array) -> float:
    """Outlet of the reactor, where a share of the feed bypasses it."""
    return float((1.0 - m[BYPASS]) * inside + m[BYPASS] * feed)


@jit
def outlet_temperature(T: float, m: Array) -> float:
    """K."""
    return outlet_of(T, 350.0 + m[FEED_TEMPERATURE], m)


@jit
def outlet_concentration(C: float, m: Array) -> float:
    """mol/l."""
    return outlet_of(C, 1.0 + m[FEED_CONCENTRATION] + m[FEED_PULSES], m)


@jit
def shown_temperature(T: float, m: Array) -> float:
    """Reading of the thermometer at its element's temperature T."""
    return float(T + m[TEMPERATURE_BIAS] + m[BOWED_THERMOMETER] * ((T - 438.54) / 10.0) ** 2)


@jit
def shown_concentration(C: float, m: Array) -> float:
    """Reading of the analyser for a sample."""
    sampled = C - m[ANALYSER_SATURATION] * max(C - HIGH_MOL_L, 0.0)
    return float(sampled * (1.0 + m[CONCENTRATION_GAIN]) + m[CONCENTRATION_BIAS])


@jit
def rates(x: Array, valve: float, m: Array, constants: Array, dx: Array) -> None:
    """The time derivatives of the state, into dx."""
    C, T = x[C_], x[T_]
    dilution = (1.0 + m[FEED_FLOW]) * (1.0 - m[BYPASS]) / (1.0 + m[VOLUME])
    k = 7.2e10 * (1.0 + m[REACTION_RATE]) * exp(-1e4 * (1.0 + m[ACTIVATION_ENERGY]) / T)
    if m[REACTION_ORDER] != 0.0:
        k *= (max(C, 1e-9) / 0.1) ** m[REACTION_ORDER]
    k /= 1.0 + m[INHIBITED_WHEN_HOT] * max(T - HOT_K, 0.0) / 10.0
    k /= 1.0 + m[SUBSTRATE_INHIBITION] * (C / 0.1) ** 2
    side = 0.0
    if m[SIDE_REACTION] != 0.0:
        side = m[SIDE_REACTION] * exp(-constants[SIDE_ACTIVATION] * (1.0 / T - 1.0 / 438.54)) * C
    flow = flow_of(valve, m)
    if m[VALVE_LAG] > LEAST_LAG_MIN:
        dx[FLOW] = (valve - x[FLOW]) / m[VALVE_LAG]
        flow = flow_of(x[FLOW], m)
    else:
        dx[FLOW] = 0.0
    duty = duty_of(T, flow, m)
    if m[JACKET_LAG] > LEAST_LAG_MIN:
        dx[DUTY] = (duty - x[DUTY]) / m[JACKET_LAG]
        duty = x[DUTY]
    else:
        dx[DUTY] = 0.0
    to_wall = constants[WALL_EXCHANGE] * (T - x[WALL])
    feed = 1.0 + m[FEED_CONCENTRATION] + m[FEED_PULSES]
    dx[C_] = dilution * (feed - C) - k * C - side - m[DILUTION_PULSES] * C
    dx[T_] = (
        dilution * (350.0 + m[FEED_TEMPERATURE] - T)
        + 200.0 * (1.0 + m[REACTION_HEAT]) * k * C
        + constants[SIDE_HEAT] * side
        + duty
        - m[HEAT_LOSS] * (T - 298.0)
        - m[BOILING] * max(T - HOT_K, 0.0)
        - m[WALL_HEAT_CAPACITY] * to_wall
        + m[RANDOM_HEAT]
    )
    dx[WALL] = to_wall
    if m[TEMPERATURE_LAG] > LEAST_LAG_MIN:
        dx[WELL] = (outlet_temperature(T, m) - x[WELL]) / m[TEMPERATURE_LAG]
    else:
        dx[WELL] = 0.0
