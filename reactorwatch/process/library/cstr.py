"""The reactor: a jacketed, continuous stirred tank with an exothermic, irreversible first-order reaction A -> B.

    dC/dt = q/V (Cf - C) - k0 C exp(-(E/R)/T)
    dT/dt = q/V (Tf - T) + K1 C exp(-(E/R)/T) + K2 qc (1 - exp(-K3/qc)) (Tcf - T)

The contents are mixed ideally and their volume, density and heat capacity are constant; the coolant flows in plug flow
through a jacket without heat capacity, which gives the exponential. K1 = (-dH) k0 / (rho cp), K2 = rho_c cp_c /
(rho cp V), K3 = hA / (rho_c cp_c).

These are the equations and constants of the benchmark "CSTR" in the DaISy database of identification data (De Moor
B.L.R., ed., ESAT-SISTA, KU Leuven), after Lightbody & Irwin (1997), Nonlinear control structures based on embedded
neural system models, IEEE Trans. Neural Networks 8(3). At most coolant flows the reactor has three steady states:
see `steady_state`.
"""

from dataclasses import replace
from functools import cache

import casadi as ca

from reactorwatch.process.effect import TIMING, Effect, EffectConstant, ParameterEffect, ParameterShift
from reactorwatch.process.law import CAPACITY, FACTOR, INPUT, SENSOR, SOURCE
from reactorwatch.process.model import Output, Place, ProcessModel, new_clock, parameter, variable
from reactorwatch.process.signal_effects import (
    InputGain,
    InputLag,
    InputStiction,
    InputTiming,
    OutputBias,
    OutputDelay,
    OutputGain,
    OutputLag,
    add_lag,
)

OPERATING_COOLANT_FLOW = 103.41
"""l/min. The flow whose steady state on the operating branch is C = 0.1 mol/l, T = 438.54 K."""

OPERATING_STATE = (0.1, 438.54)
"""(C in mol/l, T in K) at `OPERATING_COOLANT_FLOW`, as the literature rounds it."""

COOLING = "cooling"
"""Name of the term that the coolant adds to the energy balance, in K/min."""

FEED = "feed"
"""`feed C` and `feed T` are the terms that say what the feed brings, in the units of the outputs."""

REACTION = "reaction"
"""`reaction C` and `reaction T` are the terms of the reaction in the balances of mass and energy."""

_TIED = {"C": f"{REACTION} C", "T": f"{REACTION} T"}

LOCATIONS = {
    "mass_balance": "in the mass balance",
    "energy_balance": "in the energy balance",
    "reaction": "in the reaction",
    "feed": "in the feed",
    "coolant": "on the side of the coolant",
    "temperature_sensor": "in the measurement of the temperature",
    "concentration_sensor": "in the measurement of the concentration",
    TIMING: "in the times of the record",
}
"""Phrases of the locations."""

PLACES = (
    Place("reaction", "reaction", FACTOR, flows=_TIED, variables=("T", "C")),
    Place("second reaction", "reaction", FACTOR, flows=_TIED, variables=("T", "C"), apart="heat of reaction"),
    Place("heat of reaction", "reaction", FACTOR, flows={"T": f"{REACTION} T"}, variables=("T", "C")),
    Place("energy balance", "energy_balance", SOURCE, of="T", variables=("T", "C", "qc")),
    Place("heat capacity", "energy_balance", CAPACITY, of="T", variables=("T",)),
    Place("mass balance", "mass_balance", SOURCE, of="C", variables=("C", "T")),
    Place("coolant", "coolant", FACTOR, flows={"T": COOLING}, variables=("qc", "T")),
    Place("feed temperature", "feed", INPUT, of="Tf", variables=("T",), lag_min=1.0),
    Place("feed concentration", "feed", INPUT, of="Cf", variables=("C",), lag_min=1.0),
    Place("thermometer", "temperature_sensor", SENSOR, of="T", variables=("T",)),
    Place("analyser", "concentration_sensor", SENSOR, of="C", variables=("C", "T")),
)
"""Places where something unknown may act; the heat of a reaction is tied to it, but that of a second one is apart."""


@cache
def cstr() -> ProcessModel:
    """The reactor with its nominal constants: one model, so that what is compiled from it is compiled once."""
    C = variable("C", "mol/l", (0.0, 2.0), 0.1, "concentration of A in the reactor", "mass_balance")
    T = variable("T", "K", (250.0, 700.0), 10.0, "temperature of the reactor", "energy_balance")
    qc = variable("qc", "l/min", (0.0, 500.0), 10.0, "coolant flow", usual=OPERATING_COOLANT_FLOW)
    q = parameter("q", 100.0, "l/min", (1.0, 1000.0), "process flow")
    V = parameter("V", 100.0, "l", (1.0, 1000.0), "volume of the contents")
    Cf = parameter("Cf", 1.0, "mol/l", (0.0, 10.0), "concentration of A in the feed")
    Tf = parameter("Tf", 350.0, "K", (250.0, 500.0), "temperature of the feed")
    Tcf = parameter("Tcf", 350.0, "K", (250.0, 500.0), "temperature of the coolant where it enters")
    E_R = parameter("E_R", 1e4, "K", (1e3, 1e5), "activation energy over the gas constant")
    k0 = parameter("k0", 7.2e10, "1/min", (0.0, 1e15), "pre-exponential factor")
    K1 = parameter("K1", 1.44e13, "K l/(mol min)", (0.0, 1e18), "heat of reaction times k0 over rho cp")
    K2 = parameter("K2", 0.01, "1/l", (0.0, 10.0), "coolant's over the contents' heat capacity, a litre of coolant")
    K3 = parameter("K3", 700.0, "l/min", (0.0, 1e5), "heat transfer coefficient times area over coolant heat capacity")

    arrhenius = ca.exp(-E_R.symbol / T.symbol)
    flow = ca.fmax(qc.symbol, 1e-6)  # K2 qc (1 - exp(-K3/qc)) goes to zero with qc, but K3/qc is undefined there
    cooling = K2.symbol * flow * (1 - ca.exp(-K3.symbol / flow))
    dilution = q.symbol / V.symbol
    to_coolant = cooling * (Tcf.symbol - T.symbol)
    consumption, heating = -k0.symbol * C.symbol * arrhenius, K1.symbol * C.symbol * arrhenius
    return ProcessModel(
        name="cstr",
        states=(C, T),
        inputs=(qc,),
        parameters=(q, V, Cf, Tf, Tcf, E_R, k0, K1, K2, K3),
        rhs=(
            dilution * (Cf.symbol - C.symbol) + consumption,
            dilution * (Tf.symbol - T.symbol) + heating + to_coolant,
        ),
        outputs=(Output("C", C.unit, C.symbol), Output("T", T.unit, T.symbol)),
        clock=new_clock(),
        terms={
            COOLING: to_coolant,
            f"{FEED} C": Cf.symbol,
            f"{FEED} T": Tf.symbol,
            _TIED["C"]: consumption,
            _TIED["T"]: heating,
        },
        places=PLACES,
    )


class SideReaction(Effect):
    """A also goes to D, at the rate m exp(-E2 (1/T - 1/438.54)) C, and releases heat of its own.

    E2 and the heat are fitted, too. Near the main reaction's E/R it is that reaction with another heat. Nominally E2 is
    1.5 times that of A -> B: the selectivity falls with temperature, so temperature control matters. The heat, the
    temperature rise per mol/l of A that reacts to D, is half of the main reaction's, K1 / k0 = 200.
    """

    name = "side_reaction"
    label = "side reaction"
    location = "reaction"
    unit = "1/min"
    larger = "side reaction of {} 1/min at 438.54 K"
    lower = 0.0
    upper = 20.0
    typical = 0.1
    start_values = (0.02, 0.5)
    is_traced = False
    constants = (
        EffectConstant("E2", 15e3, 4e3, "K", 0.0, 1e5, "activation energy over R, of A -> D", (9e3, 19e3)),
        EffectConstant("heat", 100.0, 100.0, "K l/mol", -1e3, 1e3, "heat over rho cp, of A -> D", (0.0, 220.0)),
    )

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        C, T = model.state("C"), model.state("T")
        extended, (E2, heat) = self.add_constants(model)
        rate = size * ca.exp(-E2 * (1 / T - 1 / OPERATING_STATE[1])) * C
        return extended.add_rate("C", -rate).add_rate("T", heat * rate)


class ReactionOrder(Effect):
    """The rate, and the heat with it, times (C / 0.1)^m: the order is 1 + m.

    The rate is unchanged at the operating point's concentration.
    """

    name = "reaction_order"
    label = "wrong order of the reaction"
    location = "reaction"
    unit = "1"
    larger = "order of the reaction higher by {}"
    smaller = "order of the reaction lower by {}"
    lower = -0.9
    upper = 2.0
    typical = 0.05
    is_traced = False

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`; a solver may reach negative concentrations."""
        factor = (ca.fmax(model.state("C"), 1e-9) / OPERATING_STATE[0]) ** size
        for name in ("k0", "K1"):
            symbol = model.parameter(name).symbol
            model = model.substitute(symbol, symbol * factor)
        return model


class HeatLoss(Effect):
    """-m (T - 298 K) in the energy balance: m is heat transfer coefficient times area over rho cp V."""

    name = "heat_loss"
    label = "heat loss to the surroundings"
    location = "energy_balance"
    unit = "1/min"
    larger = "contents cool towards their surroundings at a rate of {} 1/min"
    lower = 0.0
    upper = 1.0
    typical = 0.01

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        return model.add_rate("T", -size * (model.state("T") - 298.0))


class JacketLag(Effect):
    """The cooling duty, K2 qc (1 - exp(-K3/qc)) (Tcf - T) in the energy balance, follows this value with a lag of m.

    Other effects on the coolant are part of the value that is followed.
    """

    name = "jacket_lag"
    label = "slow jacket"
    location = "coolant"
    unit = "min"
    larger = "cooling follows with a time constant of {} min"
    lower = 0.0
    upper = 10.0
    typical = 0.1
    start_values = (0.05, 0.5)
    is_traced = False

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        static = model.term(COOLING)
        state = variable(f"{self.prefix(model)}.duty", "K/min", (-1e4, 1e4), 10.0, "what the jacket takes up")
        extended, duty = add_lag(model, state, static, size)
        extended = extended.add_rate("T", duty - static)
        return replace(extended, terms={**extended.terms, COOLING: duty})


class WallHeatCapacity(Effect):
    """A wall with m times the heat capacity of the contents exchanges heat with them.

        dT/dt = ... + m r (Tw - T),    dTw/dt = r (T - Tw)

    r, the exchange, is fitted, too. Nominally it is 2/min, a time constant of half a minute: 8 mm of steel (7800 kg/m3,
    500 J/(kg K)) behind a film of 1000 W/(m2 K), as stirred liquids have it.
    """

    name = "wall_heat_capacity"
    label = "heat stored in the wall"
    location = "energy_balance"
    unit = "1"
    larger = "wall stores {} % of the heat that the contents store"
    lower = 0.0
    upper = 10.0
    typical = 0.05
    constants = (EffectConstant("exchange", 2.0, 1.0, "1/min", 0.01, 20.0, "how fast the wall follows"),)
    is_traced = False

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        prefix = self.prefix(model)
        inside = model.states[model.state_index("T")]
        bounds = (inside.lower, inside.upper)
        wall = variable(f"{prefix}.temperature", inside.unit, bounds, inside.scale, "temperature of the wall")
        extended, (exchange,) = self.add_constants(model)
        rate = exchange * (inside.symbol - wall.symbol)
        return extended.add_rate("T", -size * rate).with_state(wall, rate, at_rest=inside.symbol)


class Bypass(Effect):
    """A share m of the feed bypasses the reaction zone, and the outputs are those of the mixed outlet.

    The reaction zone is fed with q (1 - m), and each output shows (1 - m) of what it did and m of the feed.
    """

    name = "bypass"
    label = "short cut of the feed"
    location = "feed"
    unit = "1"
    larger = "{} % of the feed passes the reaction by"
    lower = 0.0
    upper = 0.9
    typical = 0.02
    is_traced = False

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        flow = model.parameter("q").symbol
        mixed = tuple(
            replace(item, expression=(1 - size) * item.expression + size * model.term(f"{FEED} {item.name}"))
            for item in model.outputs
        )
        return replace(model.substitute(flow, flow * (1 - size)), outputs=mixed)


class Volume(Effect):
    """V (1 + m); flows and hA are unchanged, so q/V and K2, which has 1/V as a factor, are divided by 1 + m.

    With level control, the set point is V_set (1 + m), and the level responds.
    """

    name = "volume"
    label = "wrong volume of the contents"
    location = "mass_balance"
    unit = "1"
    larger = "{} % more contents than stated"
    smaller = "{} % less contents than stated"
    lower = -0.9
    upper = 4.0
    typical = 0.03
    is_traced = False

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        volume = model.parameter("V_set" if "V_set" in model.parameter_names else "V").symbol
        cooling = model.parameter("K2").symbol
        return model.substitute(volume, volume * (1 + size)).substitute(cooling, cooling / (1 + size))


# fmt: off
EFFECTS: tuple[Effect, ...] = (
    ParameterShift("Tf + m.", name="feed_temperature",
                   label="wrong feed temperature", location="feed", parameter="Tf", unit="K",
                   larger="feed warmer by {} K", smaller="feed colder by {} K", lower=-50.0, upper=50.0, typical=2.0),
    ParameterShift("Cf + m.", name="feed_concentration",
                   label="wrong feed concentration", location="feed", parameter="Cf",
                   larger="feed richer in A by {} mol/l", smaller="feed poorer in A by {} mol/l", unit="mol/l",
                   lower=-1.0, upper=1.0, typical=0.01),
    ParameterEffect("q (1 + m). At constant volume the outflow is equal; with level control the level responds.",
                    name="feed_flow", label="wrong feed flow", location="feed", parameter="q", typical=0.03,
                    larger="{} % more feed", smaller="{} % less feed"),
    ParameterEffect("k0 (1 + m), and K1 (1 + m), which has k0 as a factor.", name="reaction_rate",
                    label="changed reaction rate", location="reaction", parameter="k0",
                    proportional=("K1",), larger="reaction faster by {} %", smaller="reaction slower by {} %",
                    typical=0.05, labels={"decay": "deactivation of the catalyst"}),
    ParameterEffect("E/R (1 + m).", name="activation_energy",
                    label="wrong activation energy", location="reaction", parameter="E_R",
                    larger="activation energy higher by {} %", smaller="activation energy lower by {} %",
                    lower=-0.5, upper=0.5, typical=0.002),
    ParameterEffect("K1 (1 + m), k0 unchanged.", name="reaction_heat",
                    label="wrong heat of reaction", location="reaction", parameter="K1",
                    larger="{} % more heat of reaction", smaller="{} % less heat of reaction", typical=0.01),
    SideReaction(),
    ReactionOrder(),
    ParameterEffect("K3 (1 + m): the heat transfer coefficient times the area.", name="heat_transfer",
                    label="changed heat transfer", location="coolant", parameter="K3",
                    larger="{} % more heat transfer to the coolant",
                    smaller="{} % of the heat transfer to the coolant lost", typical=-0.3,
                    labels={"ramp": "fouling of the jacket", "decay": "fouling of the jacket"}),
    HeatLoss(),
    ParameterShift("Tcf + m.", name="coolant_temperature",
                   label="wrong coolant temperature", location="coolant", parameter="Tcf",
                   larger="coolant warmer by {} K", smaller="coolant colder by {} K", unit="K",
                   lower=-50.0, upper=50.0, typical=2.0),
    JacketLag(),
    WallHeatCapacity(),
    InputLag("The real coolant flow follows qc with a time constant of m.", name="valve_lag",
             label="slow coolant valve", location="coolant", input="qc", is_traced=False,
             larger="coolant flow follows its command with a time constant of {} min"),
    InputStiction("The valve moves only when qc is more than m away from it; then it goes to qc.",
                  name="valve_stiction", label="sticking coolant valve", location="coolant", input="qc", unit="l/min",
                  larger="valve moves only for changes of more than {} l/min", upper=100.0, typical=2.0,
                  start_values=(0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4), is_traced=False),
    InputGain("The real coolant flow is qc (1 + m).", name="coolant_flow",
              label="wrong coolant flow", location="coolant", input="qc",
              larger="{} % more coolant than commanded", smaller="{} % of the coolant lost",
              labels={"step": "coolant leak", "constant": "wrong gain of the coolant valve"}),
    OutputBias("The measured temperature is T + m.", name="temperature_bias",
               label="bias of the temperature sensor", location="temperature_sensor",
               larger="thermometer shows {} K too much", smaller="thermometer shows {} K too little", output="T",
               unit="K", lower=-100.0, upper=100.0, typical=2.0, labels={"ramp": "drift of the temperature sensor"}),
    OutputLag("The measured temperature follows T with a time constant of m, as in a thermowell.",
              name="temperature_lag", label="slow thermometer", location="temperature_sensor", output="T", scale=10.0,
              larger="thermometer follows with a time constant of {} min", is_traced=False),
    OutputBias("The measured concentration is C + m.", name="concentration_bias",
               label="bias of the analyser", location="concentration_sensor", output="C",
               larger="analyser shows {} mol/l too much", smaller="analyser shows {} mol/l too little", unit="mol/l",
               lower=-1.0, upper=1.0, typical=0.01, labels={"ramp": "drift of the analyser"}),
    OutputGain("The measured concentration is C (1 + m).", name="concentration_gain",
               label="wrong gain of the analyser", location="concentration_sensor",
               output="C", larger="analyser shows {} % too much", smaller="analyser shows {} % too little",
               labels={"ramp": "drift of the gain of the analyser"}),
    OutputDelay("The measured concentration is C(t - m).", name="concentration_delay",
                label="delay of the analyser", location="concentration_sensor",
                larger="analyser shows what was there {} min before", output="C", delays_output="C", scale=0.1,
                is_traced=False),
    Bypass(),
    Volume(),
    InputTiming(name="sample_timing", label="coolant flow stamped late, or interpolated",
                larger="coolant flow stamped {} min too late"),
)
# fmt: on
"""Effects in the order feed, reaction, cooling, sensors, then effects on several of them.

The monitor compares causes within tenths of a second at a few rows after an alarm, so it traces (`Effect.is_traced`)
those that occur on a running plant and act at once: the flows, temperatures and concentrations of the feeds, the
reaction, the cooling, and the sensors. Lags, delays and a wrong volume, order or timing act from the first row on, so
the filter of the training has adapted to them; and each cause that another imitates takes probability from it. Those
are left to a diagnosis of the record.
"""
