"""The real bus: Zenoh. The only folder that imports it.

Nodes are clients of a router, because a router does not relay between two peers that do not listen, and because a node
then has to know one address only. The router may be this process (`router`), or Zenoh's own.

No published message is lost on the way as long as its publisher lives and caches it. Each publisher caches its last
messages on each key (`cache_messages`) and publishes the number of its last message twice a second; a subscriber that
finds one missing queries it, and a late subscriber may query earlier ones (`history_s`). This is Zenoh's advanced
publisher and subscriber. It does not keep the order across keys: see `reorder_buffer`.

So publishers need not wait for a congested network: they drop messages (`drop`), and a subscriber recovers them later.
A stuck subscriber then blocks no publisher. Only recovered messages are sent with waiting, because a long recovery
would otherwise be dropped in part; and a link that takes nothing for `STUCK_S` is closed.
"""

from reactorwatch.runtime.bus_zenoh.bus import ZenohBus
from reactorwatch.runtime.bus_zenoh.sessions import (
    LEASE_S,
    connect,
    connect_now,
    log_refusals,
    router,
    router_from_file,
)

__all__ = ["LEASE_S", "ZenohBus", "connect", "connect_now", "log_refusals", "router", "router_from_file"]
