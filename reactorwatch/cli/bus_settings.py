"""Bus settings of the nodes of a run: the same for all on loopback, or one for each role of a site.

In a site each node has its own certificate, and so its own settings file with a `[bus]` table. The settings file beside
them is for observers, with the site's role viewer.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import msgspec

from reactorwatch.cli.options import check_input
from reactorwatch.cli.processes import settings_text, write_settings
from reactorwatch.contract import keys
from reactorwatch.errors import InputError
from reactorwatch.runtime.bus_zenoh import ZenohBus, log_refusals, router, router_from_file
from reactorwatch.runtime.config import BusConfig, read_settings, section
from reactorwatch.runtime.security.provisioning import ROUTER, ROUTER_SETTINGS, SETTINGS
from recorder.config import RecorderConfig

VIEWER = "viewer"
ROLES = {
    "plant": "plant",
    "replay": "plant",
    "monitor": "monitor",
    "diagnosis": "monitor",
    "recorder": "recorder",
    VIEWER: VIEWER,
}
"""Roles in a site, by node; and the role of an observer."""

BusSettings = Mapping[str, BusConfig]
"""Bus settings by node, and of an observer."""


def load_bus_settings(
    site: Path | None, plant: str, tables: dict[str, dict[str, Any]], endpoint: str | None = None
) -> BusSettings:
    """Load the bus settings of each node.

    Args:
        site: folder of the site; None: all nodes have the same settings.
        plant: name of the plant.
        tables: tables of the settings file; a site's endpoint and certificates take precedence.
        endpoint: the router's address, or None.

    Raises:
        InputError: invalid settings, or a site without the plant.
    """
    if site is None:
        return dict.fromkeys(ROLES, section(BusConfig, "bus", tables, {"endpoint": endpoint}))
    if endpoint is not None:
        raise InputError(f"--endpoint {endpoint}: with --site the site has the address of its router; leave it out")
    settings = {}
    for node, role in ROLES.items():
        file = site.absolute() / plant / role / SETTINGS
        if not file.is_file():
            raise InputError(
                f"--site {site}: there is no {plant}/{role}/{SETTINGS} in it; "
                f"make it with: reactorwatch certify {site} --plant {plant}"
            )
        of_site = read_settings(file).get("bus", {})
        settings[node] = section(BusConfig, "bus", {"bus": {**tables.get("bus", {}), **of_site}}, {})
    return settings


@contextmanager
def open_router(site: Path | None, join: BusSettings) -> Iterator[ZenohBus]:
    """Run the nodes' router while the context lasts; that of a site logs refusals.

    Raises:
        InputError: its address cannot be listened at, or it has no settings.
    """
    with nullcontext() if site is None else log_refusals():
        if site is None:
            bus = router(join[VIEWER])
        else:
            bus = router_from_file(check_input(site.absolute() / ROUTER / ROUTER_SETTINGS))
        try:
            yield bus
        finally:
            bus.close()


def restrict_to_plant(recorder: RecorderConfig, site: Path | None) -> RecorderConfig:
    """Restrict a recorder in a site to its plant: a wider subscription would be refused as a whole."""
    if site is None or recorder.key_expression != keys.EVERYTHING:
        return recorder
    return msgspec.structs.replace(recorder, key_expression=f"{keys.ROOT}/{recorder.plant}/**")


def write_node_settings(
    path: Path, recorder: RecorderConfig, tables: dict[str, msgspec.Struct], join: BusSettings, nodes: Sequence[str]
) -> dict[str, Path]:
    """Write the settings files of a run.

    Args:
        path: path of the observer's file, which all nodes with the same bus settings share.
        recorder: settings of the recorder, whose recording gets the others as metadata.
        tables: the others, without those of the bus.
        join: bus settings by node.
        nodes: names of the nodes.

    Returns:
        The file of each node.
    """
    about = dict(recorder.about)
    about.setdefault("settings", settings_text({"bus": join[VIEWER], **tables}))
    tables = {**tables, "recorder": msgspec.structs.replace(recorder, about=about)}
    write_settings(path, {"bus": join[VIEWER], **tables})
    files = {}
    for node in nodes:
        files[node] = path
        if join[node] != join[VIEWER]:
            files[node] = path.with_suffix(f".{node}.toml")
            write_settings(files[node], {"bus": join[node], **tables})
    return files
