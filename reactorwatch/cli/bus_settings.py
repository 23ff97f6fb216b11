"""How the nodes of a run join their bus: all alike on loopback, or each as its role in a site.

In a site each node shows a certificate of its own, so each has settings of its own, whose `[bus]` names it. The
settings that are written down beside them are for who looks on, as the site's viewer.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import msgspec

from reactorwatch.cli.options import existing
from reactorwatch.cli.processes import write_settings
from reactorwatch.contract import keys
from reactorwatch.errors import InputError
from reactorwatch.runtime.bus_zenoh import ZenohBus, log_refusals, router, router_from_file
from reactorwatch.runtime.config import BusConfig, read_settings, section
from reactorwatch.runtime.security.provisioning import ROUTER, ROUTER_SETTINGS, SETTINGS
from recorder.config import RecorderConfig

VIEWER = "viewer"
ROLES = {"plant": "plant", "monitor": "monitor", "diagnosis": "monitor", "recorder": "recorder", VIEWER: VIEWER}
"""In a site, by node; and of who looks on."""

Joining = Mapping[str, BusConfig]
"""How each node, and who looks on, joins the bus."""


def joining(site: Path | None, plant: str, tables: dict[str, dict[str, Any]], endpoint: str | None = None) -> Joining:
    """How each node joins.

    Args:
        site: its folder; None: there is none, and all join alike.
        plant: of the nodes.
        tables: of the settings file; where the bus is and who joins it are the site's to say.
        endpoint: the router's address, or None.

    Raises:
        InputError: settings that cannot be used, or a site that does not know the plant.
    """
    if site is None:
        return dict.fromkeys(ROLES, section(BusConfig, "bus", tables, {"endpoint": endpoint}))
    if endpoint is not None:
        raise InputError(f"--endpoint {endpoint}: with --site the site says where its router is; leave it out")
    found = {}
    for node, role in ROLES.items():
        file = site.absolute() / plant / role / SETTINGS
        if not file.is_file():
            raise InputError(
                f"--site {site}: there is no {plant}/{role}/{SETTINGS} in it; "
                f"make it with: reactorwatch certify {site} --plant {plant}"
            )
        of_site = read_settings(file).get("bus", {})
        found[node] = section(BusConfig, "bus", {"bus": {**tables.get("bus", {}), **of_site}}, {})
    return found


@contextmanager
def open_router(site: Path | None, join: Joining) -> Iterator[ZenohBus]:
    """Be the router that the nodes join, while the context lasts; that of a site logs what it refuses.

    Raises:
        InputError: nothing can listen at its address, or it has no settings.
    """
    with nullcontext() if site is None else log_refusals():
        if site is None:
            bus = router(join[VIEWER])
        else:
            bus = router_from_file(existing(site.absolute() / ROUTER / ROUTER_SETTINGS))
        try:
            yield bus
        finally:
            bus.close()


def heard_by(recorder: RecorderConfig, site: Path | None) -> RecorderConfig:
    """The settings of a recorder that asks a site for no more than its plant: more would be refused as a whole."""
    if site is None or recorder.key_expression != keys.EVERYTHING:
        return recorder
    return msgspec.structs.replace(recorder, key_expression=f"{keys.ROOT}/{recorder.plant}/**")


def write_node_settings(
    path: Path, tables: dict[str, msgspec.Struct], join: Joining, nodes: Sequence[str]
) -> dict[str, Path]:
    """Write down the settings of a run.

    Args:
        path: of those for who looks on, which are all nodes' where all join alike.
        tables: all but the bus.
        join: how each node joins.
        nodes: that there are.

    Returns:
        The file of each.
    """
    write_settings(path, {"bus": join[VIEWER], **tables})
    files = {}
    for node in nodes:
        files[node] = path
        if join[node] != join[VIEWER]:
            files[node] = path.with_suffix(f".{node}.toml")
            write_settings(files[node], {"bus": join[node], **tables})
    return files
