"""`view`: dashboard of a running plant, in a window or in the browser."""

from typing import Annotated

from typer import Option

from reactorwatch.cli.options import PlantOptions, Process
from reactorwatch.cli.printing import print_lines

LOOPBACK = "127.0.0.1"


def view(
    *,
    target: PlantOptions,
    process: Process = None,
    web: Annotated[bool, Option("--web", help="In the browser, at the address that is printed.")] = False,
    bind: Annotated[str, Option(help="The address that the viewer listens on.")] = LOOPBACK,
    port: Annotated[
        int | None,
        Option(
            help="For the browser; the one after it carries the data [two that are free].",
            min=1024,
            max=65534,
        ),
    ] = None,
) -> None:
    """Show a running plant live: a window, or with --web a page for the browser.

    Ends when the window is closed or with Ctrl-C. The last minute before the start is shown, too.
    """
    import logging
    from dataclasses import replace

    from reactorwatch.cli.observer import load_recorder_settings, observed_process
    from reactorwatch.description.find import find_process
    from recorder.view.viewer import DisplayTarget, show

    if process is not None and target.config is None:
        target = replace(target, name=target.name or find_process(process).name)
    bus, recorder = load_recorder_settings(target, logging.INFO)
    described = observed_process(process, recorder)
    show(recorder.plant, bus, DisplayTarget(web=web, bind=bind, port=port), print_lines, described)
