"""The real bus: Zenoh. The only folder that imports it.

Nodes are clients of a router, because a router does not relay between two peers that don't listen, and because
one address is all that a node then has to know. The router may be this process (`router`), or Zenoh's own.

Nothing that was published is lost on the way as long as its publisher lives and remembers it. Each publisher keeps its
last messages on each key (`cache_messages`) and tells twice a second which was its last; a subscriber that finds one
missing asks for it, and one that comes late may ask for what was published before (`history_s`). This is Zenoh's
advanced publisher and subscriber. What it cannot do is keep the order across keys: see `in_order`.

So publishers need not wait for a network that takes no more: they throw away (`drop`), and what a subscriber thereby
misses it gets later. A subscriber that is stuck then holds nobody up. Only what somebody asked for again is sent
with waiting, for else a long recovery would be thrown away in part; and a link that takes nothing for `STUCK_S` is
closed.
"""

from reactorwatch.runtime.bus_zenoh.bus import ZenohBus
from reactorwatch.runtime.bus_zenoh.refusal_log import log_refusals
from reactorwatch.runtime.bus_zenoh.sessions import connect, connect_now, router, router_from_file

__all__ = ["ZenohBus", "connect", "connect_now", "log_refusals", "router", "router_from_file"]
