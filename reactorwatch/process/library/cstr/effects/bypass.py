"""Bypass of the feed to the outlet."""

from dataclasses import replace

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr.model import FEED
from reactorwatch.process.model import ProcessModel


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
