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

from functools import cache

import casadi as ca

from reactorwatch.process.model import Output, Place, ProcessModel, new_clock, parameter, variable
from reactorwatch.process.places import CAPACITY, FACTOR, INPUT, SENSOR, SOURCE

SMALLEST_COOLANT_FLOW = 1e-6
"""l/min. A smaller flow counts as this: K2 qc (1 - exp(-K3/qc)) goes to zero with qc, but K3/qc is undefined there."""

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
    flow = ca.fmax(qc.symbol, SMALLEST_COOLANT_FLOW)
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
