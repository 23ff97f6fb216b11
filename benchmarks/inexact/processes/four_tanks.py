"""Four tanks (Johansson 2000, IEEE Trans. Control Systems Technology 8, 456-465) with the constants of pcgym."""

import casadi as ca

import reactorwatch as rw


def process() -> rw.Process:
    """Describe the process."""
    h = [rw.variable(f"h{i}", "m", (0.0, 2.0), 0.1, f"level {i}", balance=f"tank{i}") for i in (1, 2, 3, 4)]
    v1, v2 = (rw.variable(f"v{i}", "V", (0.0, 10.0), 3.0, f"pump {i}") for i in (1, 2))
    outlets = (0.0035, 0.0030, 0.0020, 0.0025)
    a = [rw.parameter(f"a{i}", area, "m2", (0.0, 0.05), f"outlet {i}") for i, area in enumerate(outlets, 1)]
    k1, k2 = (rw.parameter(f"k{i}", k, "m3/s", (0.0, 0.01), f"gain of pump {i}") for i, k in ((1, 8.5e-4), (2, 9.5e-4)))
    gammas = [rw.parameter(f"gamma{i}", 0.2, "1", (0.0, 1.0), f"share of pump {i} to tank {i}") for i in (1, 2)]
    out = [area.symbol * ca.sqrt(2.0 * 9.81 * ca.fmax(level.symbol, 0.0)) for area, level in zip(a, h, strict=True)]
    flow1, flow2 = k1.symbol * v1.symbol, k2.symbol * v2.symbol
    gamma1, gamma2 = (item.symbol for item in gammas)
    gains = (
        gamma1 * flow1 + out[2] - out[0],
        gamma2 * flow2 + out[3] - out[1],
        (1.0 - gamma2) * flow2 - out[2],
        (1.0 - gamma1) * flow1 - out[3],
    )
    rates = tuple(60.0 * gain for gain in gains)  # m a minute, of 1 m2
    outputs = tuple(rw.Output(level.name, "m", level.symbol) for level in h)
    model = rw.ProcessModel("four_tanks", tuple(h), (v1, v2), (*a, k1, k2, *gammas), rates, outputs, rw.new_clock())
    signals = [rw.Signal(v.name, "V", "input") for v in (v1, v2)]
    return rw.Process("four_tanks", (*signals, *(rw.Signal(level.name, "m", "output") for level in h)), model)
