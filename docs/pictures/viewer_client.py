"""Client of a running Rerun viewer: state, screenshots and tabs."""

from typing import Any

from rerun.experimental import ViewerClient


class Viewer:
    """Client of a viewer on this machine.

    Args:
        port: port of the viewer.

    Raises:
        ConnectionError: nothing listens on the port.
    """

    def __init__(self, port: int) -> None:
        self._client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")

    @property
    def is_ready(self) -> bool:
        """True if a view is shown and nothing is being loaded."""
        state = self._client.get_state()
        return bool(state.views) and not state.loading

    def hide_top(self) -> None:
        """Hide the bar at the top, whose warning of slow drawing does not matter in a picture."""
        self._client.run_command("ui.toggle_top_panel")

    def screenshot(self) -> bytes:
        """Screenshot as PNG."""
        return self._client.take_screenshot()

    @property
    def tabs(self) -> dict[str, str]:
        """Identifiers of the tabs in the layout, by title."""
        layout = self._layout()
        _, root = _find_tabs(layout)
        contents = root.get("contents", [])
        paths = [contents] if isinstance(contents, str) else contents  # the viewer returns a list of one as its item
        return {layout[f"/{path}"]["ContainerBlueprint"]["display_name"]: path for path in paths}

    def open_tab(self, tab: str) -> None:
        """Activate a tab by its identifier in the layout."""
        layout = self._layout()
        path, root = _find_tabs(layout)
        layout[path]["ContainerBlueprint"] = {**root, "active_tab": tab}
        self._client.set_blueprint(layout, "recording")

    def _layout(self) -> dict[str, Any]:
        return self._client.get_blueprint("recording").blueprint


def _find_tabs(layout: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Find the container of the tabs; returns its path and content, both empty if there is none."""
    for path, archetypes in layout.items():
        container = archetypes.get("ContainerBlueprint", {})
        if container.get("container_kind") == "Tabs":
            return path, container
    return "", {}
