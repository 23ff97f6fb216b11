"""The timestamps of the coolant flow are late."""

from dataclasses import replace

import casadi as ca

from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.effect_states import nonnegative
from reactorwatch.process.integrate import symbolic_step
from reactorwatch.process.model import Clock, ProcessModel
from reactorwatch.process.profiles import Profile

STEPS = 2
"""Number of integration steps over m."""


class SampleTiming(Effect):
    """The input of a row has acted on the plant for m when the row is measured.

    At any time t the plant responds to the input stamped t + m(t); the timestamps of the measurements are right. The
    state of a row is that at the time from which on its input acts, m before the row, and the measurement is m later:
    y_k = h(Phi_m(x_k, u_k)). So while m grows, the states' time step is shorter than the clock's by m's growth
    (`ProcessModel.time_offset`). A shift cannot act before its onset, so m is at most the time since then, during which
    the states stand still. That is exact for a constant m and for a step, however irregular the rows, as long as m is
    at most the time until the next row; a larger m would need the input of later rows. For a slowly growing profile m
    is evaluated at the row instead of m before it, an error of m times its growth.

    To first order, an input that is interpolated between the rows is one that is held, with m of half a period.

    Among the effects of a model this must be the last: its outputs are those of the model that it is applied to, m
    later, and the onsets of the others are in that model's time.
    """

    name = "sample_timing"
    label = "coolant flow stamped late, or interpolated"
    location = TIMING
    unit = "min"
    larger = "coolant flow stamped {} min too late"
    lower = 0.0
    upper = 0.5
    typical = 0.05
    is_traced = False

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        symbols, clock = model.arguments(), model.clock
        x, u, p = symbols
        step, shown = symbolic_step(model), model.function("shown")
        late = nonnegative(size)
        h = late / STEPS
        for i in range(STEPS):
            x = step(x, u, p, clock.now + i * h, clock.middle, h)[0]
        later = ca.vertsplit(shown(x, u, p, clock.now + late, clock.middle)[1])
        return replace(
            model,
            outputs=tuple(replace(item, expression=y) for item, y in zip(model.outputs, later, strict=True)),
            time_offset=model.time_offset + size,
        )

    def size_signal(self, clock: Clock, profile: Profile, symbols: dict[str, ca.SX]) -> ca.SX:
        """See `Effect`; at most the time since the onset."""
        late = nonnegative(super().size_signal(clock, profile, symbols))
        if "onset" not in symbols:
            return late
        return ca.fmin(late, ca.fmax(clock.now - symbols["onset"], 0))
