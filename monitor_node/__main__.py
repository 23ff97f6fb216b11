"""The monitor as a process: configuration, bus, node, loop.

python -m monitor_node [settings.toml]
"""

import sys
import time
from functools import partial
from itertools import chain
from math import inf
from pathlib import Path

import structlog

from monitor_node.causes import stage
from monitor_node.charts import shift_and_drift as drift
from monitor_node.config import MonitorConfig
from monitor_node.core import COMMANDS
from monitor_node.fleet import ONE_PLANT, FleetConfig, load_kinds, prepare
from monitor_node.health import NODE
from monitor_node.node import MonitorNode, instance_token
from reactorwatch.contract import keys
from reactorwatch.errors import InputError
from reactorwatch.records.write import make_folder
from reactorwatch.runtime.bus import Bus
from reactorwatch.runtime.config import BusConfig, MetricsConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal, stop_on_signals
from reactorwatch.runtime.http_pages import Metrics, serve_metrics
from reactorwatch.runtime.node_main import main
from reactorwatch.runtime.start import join, wait_ready

log = structlog.get_logger()

UNCACHED = (keys.HEALTH, keys.ALARM_KPIS)
"""Periodic messages of each plant; a cache of them would take more memory than all else of a plant of a fleet."""


def run(
    config: MonitorConfig,
    bus_config: BusConfig,
    metrics_config: MetricsConfig = MetricsConfig(),  # noqa: B008 (it is frozen)
    fleet: FleetConfig = ONE_PLANT,
    state: Path | None = None,
) -> None:
    """Run the monitor of one plant or of a fleet until SIGINT or SIGTERM.

    Args:
        config: settings of each plant's monitor.
        bus_config: settings of the bus.
        metrics_config: settings of the metrics.
        fleet: settings of the fleet; by default the one plant of the monitor's settings is watched.
        state: folder of the files of one plant's monitor, which is made if it does not exist; None: it is there.

    Raises:
        InputError: the settings are inconsistent, or a file of the settings or the folder of states is unusable.
    """

    def start() -> MonitorNode:
        if state is not None:
            make_folder(state, "--state")
        return MonitorNode(config, time.time_ns(), fleet, metrics, token, kinds)

    if fleet.shards is not None:
        raise InputError("[fleet] shards are placed on a cluster by `reactorwatch monitor`; a monitor has one shard")
    is_single = fleet.plants is None
    kinds = load_kinds(fleet.share_promise(config), fleet)  # errors in the settings are raised before it joins
    if not is_single:
        if config.state_file is not None:
            raise InputError("state_file holds what is known of one plant; a fleet takes [fleet] state, a folder")
        if fleet.share_per_30_days is not None:
            text = f"{fleet.false_alarms_per_day:g} false alarms a day are promised for {fleet.divisor} plants"
            log.info(text, per_plant_in_30_days=fleet.share_promise(config).false_alarms_per_30_days)
        prepare(kinds, points=fleet.points)  # before plants wait
    token = instance_token(config, fleet)
    options = {} if is_single else {"uncached": UNCACHED, "many_keys": True}
    with (
        serve_metrics(metrics_config, Metrics(NODE)) as metrics,
        stop_on_signals() as stop,
        join(bus_config, NODE, stop, token, **options) as bus,
    ):
        begin_ns = time.time_ns()
        # Its files are read once no other monitor writes them.
        node = None if bus is None else wait_ready(start, bus, NODE, config.plant if is_single else None, stop)
        if bus is None or node is None:
            return
        if is_single:
            monitor = node.monitor(config.plant)
            length = monitor.config.training_length
            log.info("training", plant=config.plant, training_min=length.minutes, training_rows=length.rows or None)
            wanted = drift.preparation(monitor.config, wanted=True)
            node.preparation = chain(wanted, stage.preparation(monitor.config, monitor.pipeline.baselines.equations))
            # All samples published since the state was stored, however long ago; the node skips those it knows.
            history_s = inf if node.resumed else 0.0
        else:  # a plant of which no state was stored yet has a history, too
            read_s = (time.time_ns() - begin_ns) / 1e9
            history_s = 0.0 if fleet.state is None else bus_config.history_s + read_s
        watch(node, bus, stop, history_s)


def watch(node: MonitorNode, bus: Bus, stop: StopSignal, history_s: float = 0.0) -> None:
    """Run a monitor until it is asked to stop."""
    log.info("listening", plants=node.expression)
    loop = EventLoop(
        node,
        bus,
        stop,
        # a stopping monitor has received everything after half a second without messages
        drain_timeout_s=0.5,
        on_publish=node.metrics.on_publish if node.metrics is not None else None,
        on_backlog=partial(setattr, node, "is_behind"),
    )
    samples = keys.samples_of(node.expression)
    # Batches cost a fleet less time, and each sample up to 5 ms, which the alarms of one plant need not wait.
    on_batch = None if node.is_single else node.on_messages
    loop.subscribe(
        samples,
        history_s=history_s,
        on_history_end=node.on_history_end,
        on_batch=on_batch,
        late_rows=node.late_rows,
    )
    loop.subscribe_liveliness(*node.tokens, on_token=node.on_alive)
    loop.accept_commands(*(f"{node.expression}/{keys.COMMAND}/{name}" for name in COMMANDS))
    node.declare_tokens(bus)
    loop.run()


if __name__ == "__main__":
    sys.exit(main("monitor_node", "monitor", MonitorConfig, run, fleet=FleetConfig))
