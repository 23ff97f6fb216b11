"""`python -m plant_node [settings.toml]`: the plant as a process."""

import sys
from collections.abc import Callable

import msgspec
import structlog

from plant_node.config import PlantConfig
from plant_node.node import COMMANDS, NODE, PlantNode
from plant_node.record import plant_from
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.runtime.bus import Bus
from reactorwatch.runtime.config import BusConfig, MetricsConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal, stop_on_signals
from reactorwatch.runtime.http_pages import Metrics, serve_metrics
from reactorwatch.runtime.node_main import main
from reactorwatch.runtime.start import instance_name, join, wait_alive

log = structlog.get_logger()


def run(
    config: PlantConfig,
    bus_config: BusConfig,
    metrics_config: MetricsConfig = MetricsConfig(),  # noqa: B008 (it is frozen)
) -> None:
    """Simulate a plant on the bus until the end of its duration, SIGINT or SIGTERM."""
    plant = plant_from(config)
    log.info("plant", seed=config.seed, settings=msgspec.to_builtins(config))
    token = keys.instance_token(config.name, NODE, instance_name())
    with (
        serve_metrics(metrics_config, Metrics(NODE, {config.name: None})) as metrics,
        stop_on_signals() as stop,
        join(bus_config, NODE, stop, token) as bus,
    ):
        if bus is not None:
            node = PlantNode(plant, config, log.info)
            serve_plant(node, config, bus, stop, metrics.on_publish if metrics is not None else None)


def serve_plant(
    node: PlantNode,
    config: PlantConfig,
    bus: Bus,
    stop: StopSignal,
    on_publish: Callable[[Publication], None] | None = None,
) -> None:
    """Run the node on an open bus: take commands, declare liveliness, wait for other nodes, publish rows."""
    loop = EventLoop(node, bus, stop, on_publish=on_publish)
    loop.accept_commands(*(keys.key(config.name, keys.COMMAND, name) for name in COMMANDS))
    bus.declare_token(keys.key(config.name, keys.ALIVE, NODE))
    wait_alive(bus, config.name, config.wait_for, stop, NODE)
    loop.run()


if __name__ == "__main__":
    sys.exit(main("plant_node", "plant", PlantConfig, run))
