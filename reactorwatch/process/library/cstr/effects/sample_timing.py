"""The coolant flow is stamped too late."""

from dataclasses import replace

import casadi as ca

from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.effect_states import positive
from reactorwatch.process.integrate import symbolic_step
from reactorwatch.process.model import Clock, ProcessModel
from reactorwatch.process.profiles import Profile

STEPS = 2
"""Of the integrator, over m."""


class SampleTiming(Effect):
    """The plant has felt the input of a row for m already when the row is measured.

    At any time t the plant feels the input that is stamped t + m(t); what is measured is stamped in time. The state of
    a row is taken for that at the moment from which on its input acts, m before the row, and what is measured lies m
    later: y_k = h(Phi_m(x_k, u_k)). So while m grows the states go on for less than the clock does
    (`ProcessModel.clock_ahead`), from one row to the next for the time between them less what m has grown by. A shift
    that sets in cannot act before it does, so m is at most the time since its onset: while less than m has gone by, the
    states stand still. That is exact for a constant m and for a step, however irregular the rows, as long as m is at
    most the time until the next row; a larger m would need the input of later rows. Of a course that grows slowly m is
    taken at the row instead of m before it, which is off by m times its growth.

    An input that is interpolated between the rows instead of held is, to first order, held with m of half a period.

    Of effects in one model this must come last: the outputs are those of the model that it is applied to, m later, and
    what sets in with the others does so in that model's time.
    """

    name = "sample_timing"
    label = "coolant flow stamped late, or interpolated"
    location = TIMING
    unit = "min"
    larger = "coolant flow stamped {} min too late"
    lower = 0.0
    upper = 0.5
    typical = 0.05

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        symbols, clock = model.arguments(), model.clock
        x, u, p = symbols
        step, shown = symbolic_step(model), model.function("shown")
        late = positive(size)
        h = late / STEPS
        for number in range(STEPS):
            x = step(x, u, p, clock.now + number * h, clock.middle, h)[0]
        later = ca.vertsplit(shown(x, u, p, clock.now + late, clock.middle)[1])
        return replace(
            model,
            outputs=tuple(replace(item, expression=y) for item, y in zip(model.outputs, later, strict=True)),
            clock_ahead=model.clock_ahead + size,
        )

    def course(self, clock: Clock, profile: Profile, symbols: dict[str, ca.SX]) -> ca.SX:
        """See `Effect`; at most the time since the onset."""
        late = positive(super().course(clock, profile, symbols))
        if "onset" not in symbols:
            return late
        return ca.fmin(late, ca.fmax(clock.now - symbols["onset"], 0))
