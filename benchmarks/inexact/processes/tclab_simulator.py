"""TCLab's simulator as its documentation states it: heaters that lose heat to the room, and slower sensors on them."""

import reactorwatch as rw


def process() -> rw.Process:
    """Describe the process."""
    Q1, Q2 = (rw.variable(f"Q{i}", "%", (0.0, 100.0), 30.0, f"heater {i}") for i in (1, 2))
    H1, H2 = (rw.variable(f"H{i}", "degC", (-50.0, 200.0), 10.0, f"heater {i}", balance=f"heater{i}") for i in (1, 2))
    T1, T2 = (rw.variable(f"T{i}", "degC", (-50.0, 200.0), 10.0, f"sensor {i}", balance=f"sensor{i}") for i in (1, 2))
    P1 = rw.parameter("P1", 200.0, "1", (0.0, 255.0), "power of heater 1, pulse width")
    P2 = rw.parameter("P2", 100.0, "1", (0.0, 255.0), "power of heater 2, pulse width")
    Ta = rw.parameter("Ta", 21.0, "degC", (-20.0, 50.0), "temperature of the room")
    loss = rw.parameter("loss", 3.0, "1/min", (0.1, 30.0), "heat loss of a heater")
    across = rw.parameter("across", 0.6, "1/min", (0.0, 6.0), "heat exchange of the heaters")
    lag = rw.parameter("lag", 140.0 / 60.0, "min", (0.1, 20.0), "time constant of the sensors")
    exchanged = across.symbol * (H1.symbol - H2.symbol)
    rates = (
        60.0 * P1.symbol * Q1.symbol / 5720.0 + loss.symbol * (Ta.symbol - H1.symbol) - exchanged,
        60.0 * P2.symbol * Q2.symbol / 5720.0 + loss.symbol * (Ta.symbol - H2.symbol) + exchanged,
        (H1.symbol - T1.symbol) / lag.symbol,
        (H2.symbol - T2.symbol) / lag.symbol,
    )
    outputs = tuple(rw.Output(T.name, "degC", T.symbol) for T in (T1, T2))
    constants = (P1, P2, Ta, loss, across, lag)
    model = rw.ProcessModel("simulator", (H1, H2, T1, T2), (Q1, Q2), constants, rates, outputs, rw.new_clock())
    signals = [rw.Signal(Q.name, "%", "input") for Q in (Q1, Q2)]
    return rw.Process("simulator", (*signals, *(rw.Signal(T.name, "degC", "output") for T in (T1, T2))), model)
