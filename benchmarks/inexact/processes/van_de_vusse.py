"""Van de Vusse's reactor (Klatt & Engell 1998, Computers Chem. Engng 22, 491-502) with do-mpc's constants."""

import casadi as ca

import reactorwatch as rw


def process() -> rw.Process:
    """Describe the process."""
    Ca = rw.variable("C_a", "mol/l", (0.0, 10.0), 0.5, "concentration of A", balance="A")
    Cb = rw.variable("C_b", "mol/l", (0.0, 10.0), 0.5, "concentration of B", balance="B")
    TR = rw.variable("T_R", "degC", (0.0, 250.0), 10.0, "reactor", balance="reactor")
    TK = rw.variable("T_K", "degC", (0.0, 250.0), 10.0, "jacket", balance="jacket")
    F = rw.variable("F", "1/h", (0.0, 100.0), 10.0, "flow per volume")
    Q = rw.variable("Q_dot", "kJ/h", (-8500.0, 0.0), 2000.0, "heat to the jacket")
    constants = (
        rw.parameter("K0_ab", 1.287e12, "1/h", (1e11, 1e13), "frequency factor A to B"),
        rw.parameter("K0_bc", 1.287e12, "1/h", (1e11, 1e13), "frequency factor B to C"),
        rw.parameter("K0_ad", 9.043e9, "l/mol/h", (1e9, 1e11), "frequency factor A to D"),
        rw.parameter("H_ab", 4.2, "kJ/mol", (0.0, 50.0), "heat taken by A to B"),
        rw.parameter("H_bc", 11.0, "kJ/mol", (0.0, 50.0), "heat of B to C"),
        rw.parameter("H_ad", 41.85, "kJ/mol", (0.0, 100.0), "heat of A to D"),
        rw.parameter("K_w", 4032.0, "kJ/h/m2/K", (100.0, 20000.0), "heat transfer to the jacket"),
        rw.parameter("C_A0", 5.1, "mol/l", (0.1, 20.0), "concentration of the feed"),
        rw.parameter("T_in", 130.0, "degC", (0.0, 250.0), "temperature of the feed"),
    )
    K0_ab, K0_bc, K0_ad, H_ab, H_bc, H_ad, K_w, C_A0, T_in = (item.symbol for item in constants)
    K = TR.symbol + 273.15
    ab = K0_ab * ca.exp(-9758.3 / K) * Ca.symbol
    bc = K0_bc * ca.exp(-9758.3 / K) * Cb.symbol
    ad = K0_ad * ca.exp(-8560.0 / K) * Ca.symbol**2
    wall = K_w * 0.215 * (TR.symbol - TK.symbol)  # kJ/h
    hourly = (
        F.symbol * (C_A0 - Ca.symbol) - ab - ad,
        ab - bc - F.symbol * Cb.symbol,
        (bc * H_bc + ad * H_ad - ab * H_ab) / (0.9342 * 3.01)
        + F.symbol * (T_in - TR.symbol)
        - wall / (0.9342 * 3.01 * 10.01),
        (Q.symbol + wall) / (5.0 * 2.0),
    )
    measured = (Cb, TR, TK)
    outputs = tuple(rw.Output(item.name, item.unit, item.symbol) for item in measured)
    rates = tuple(item / 60.0 for item in hourly)
    model = rw.ProcessModel("van_de_vusse", (Ca, Cb, TR, TK), (F, Q), constants, rates, outputs, rw.new_clock())
    signals = [rw.Signal(item.name, item.unit, "input") for item in (F, Q)]
    return rw.Process(model.name, (*signals, *(rw.Signal(y.name, y.unit, "output") for y in measured)), model)
