"""Commands of a site: `certify` makes certificates and rules, `router` enforces them, `doctor` checks."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from reactorwatch.cli.display import json_line, print_lines
from reactorwatch.cli.option_groups import BUS, BusOptions, PlantOptions, fold
from reactorwatch.cli.options import MAX_WAIT_S, Json, check_input
from reactorwatch.errors import InputError


@dataclass(frozen=True)
class DoctorOptions(PlantOptions):
    """Settings file, router, plant and timeout of a check."""

    timeout: Annotated[float, fold(BUS, help="Seconds to listen for nodes.", min=0.1, max=MAX_WAIT_S)] = 12.0


def certify(
    folder: Annotated[Path, Argument(help="Of the site: new, or one to add to.")],
    plant: Annotated[
        list[str] | None, Option(help="A plant to add, or '*': members for all [those there, or cstr]. Repeatable.")
    ] = None,
    endpoint: Annotated[
        str | None, Option(help="Address at which nodes connect to the router [as before, or tls/127.0.0.1:7447].")
    ] = None,
    listen: Annotated[
        str | None, Option(help="Address at which the router listens [as before, or --endpoint].")
    ] = None,
    days: Annotated[float, Option(help="How long certificates are valid.", min=1, max=3650)] = 365.0,
    renew: Annotated[
        float | None, Option(help="Renew certificates that end within this many days.", min=0, max=3650)
    ] = None,
    revoke: Annotated[
        list[str] | None,
        Option(
            help="Make the router refuse the present certificates of this plant and role, such as cstr/monitor or "
            "fleet/monitor, and make a new one. Repeatable."
        ),
    ] = None,
) -> None:
    """Make the certificates and access rules of a site.

    Each client of its bus gets a folder of its own, to be copied to its machine: certificate, key and settings for
    --config. Complete folders stay, incomplete ones are completed: a plant is added by naming it. The router's rules
    are written again; restart it after that, unless certificates were only renewed.
    """
    from datetime import UTC, datetime

    from reactorwatch.runtime.provisioning import AUTHORITY, CLUSTER, ROUTER, ROUTER_SETTINGS, make_site

    notes = {
        AUTHORITY: "; signs new certificates, keep it off line",
        CLUSTER: "; holders run code on the workers; restart scheduler and workers together, with this certificate",
    }
    now, revoked = datetime.now(UTC), tuple(revoke or ())
    for made in make_site(folder, tuple(plant or ()), endpoint, listen, days, now, renew_days=renew, revoke=revoked):
        print_lines(f"{made}{notes.get(made.name, '')}")
    for holder in revoke or ():
        print_lines(
            f"{folder / ROUTER / ROUTER_SETTINGS}: refuses earlier certificates of {holder}; restart the router"
        )


def router(
    *,
    file: Annotated[
        Path | None,
        Argument(
            help="Zenoh's settings, as `certify` writes them: router.json5 [a plain router, on this machine alone]."
        ),
    ] = None,
    target: BusOptions,
) -> None:
    """Run a router until stopped: that of a site, with certificates and access rules, or without a file a plain one.

    Refused messages are logged.
    """
    import structlog

    from reactorwatch.runtime.bus_zenoh import log_refusals, router_from_file
    from reactorwatch.runtime.bus_zenoh import router as plain_router
    from reactorwatch.runtime.config import BusConfig, LogConfig, read_settings, section
    from reactorwatch.runtime.event_loop import retry, stop_on_signals
    from reactorwatch.runtime.node_main import configure_log

    if file is not None and (target.config is not None or target.endpoint is not None):
        raise InputError(f"{file}: has the address of this router; leave out --config and --endpoint")
    tables = read_settings(target.config)
    settings = section(BusConfig, "bus", tables, {"endpoint": target.endpoint})
    configure_log(as_json=section(LogConfig, "log", tables, {}).format == "json")
    log = structlog.get_logger()
    with log_refusals(), stop_on_signals() as stop:
        bus = retry(
            lambda: router_from_file(check_input(file)) if file is not None else plain_router(settings),
            stop.wait,
            lambda why, is_new: log.warning("waiting", node="router", why=why) if is_new else None,
        )
        if bus is None:
            return
        log.info("router", **({"settings": str(file)} if file else {"endpoint": settings.endpoint}))
        try:
            stop.wait()
        finally:
            bus.close()


def doctor(
    *,
    target: DoctorOptions,
    as_json: Json = False,
) -> None:
    """Check a deployment from here: one line a check, with the cure. Ends with 0 if all checks pass, 1 if not."""
    from datetime import UTC, datetime
    from itertools import chain

    from monitor_node.fleet import FleetConfig
    from reactorwatch.cli.bus_client import load_settings
    from reactorwatch.cli.doctor import check_cluster, run_checks
    from reactorwatch.runtime.config import section
    from recorder.config import RecorderConfig

    tables, bus = load_settings(target)
    recorder = section(RecorderConfig, "recorder", tables, {"plant": target.name})
    fleet, now = section(FleetConfig, "fleet", tables, {}), datetime.now(UTC)
    out = Path(recorder.out)
    folder = out.parent if out.suffix == ".mcap" else out
    is_well = True
    checks = []
    findings = run_checks(bus, recorder.plant, folder, recorder.rotate_mb, target.timeout, now)
    for finding in chain(findings, check_cluster(fleet, bus, now)):
        is_well = is_well and not finding.cure
        checks.append({"ok": not finding.cure, **finding._asdict()})
        if not as_json:
            cure = f"; {finding.cure}" if finding.cure else ""
            print_lines(f"{'WRONG' if finding.cure else 'ok':5s}  {finding.check}: {finding.found}{cure}")
    if as_json:
        print_lines(json_line({"ok": is_well, "checks": checks}))
    raise typer.Exit(0 if is_well else 1)
