"""A viewer of Rerun's that runs: asked what it shows, and which tab is to be in front."""

from typing import Any

from rerun.experimental import ViewerClient


class Viewer:
    """A viewer on this machine.

    Args:
        port: that it listens at.

    Raises:
        ConnectionError: nothing listens there.
    """

    def __init__(self, port: int) -> None:
        self._client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")

    @property
    def is_ready(self) -> bool:
        """Whether there is something on the screen, and nothing that is still being loaded."""
        state = self._client.get_state()
        return bool(state.views) and not state.loading

    def hide_top(self) -> None:
        """Hide the bar at the top: it warns of slow drawing, which is no matter in a picture."""
        self._client.run_command("ui.toggle_top_panel")

    def screenshot(self) -> bytes:
        """What is on the screen, as PNG."""
        return self._client.take_screenshot()

    @property
    def tabs(self) -> dict[str, str]:
        """The tabs: by title, what the layout calls each."""
        layout = self._layout()
        _, root = _tabbed(layout)
        contents = root.get("contents", [])
        paths = [contents] if isinstance(contents, str) else contents  # the viewer gives a list of one as its item
        return {layout[f"/{path}"]["ContainerBlueprint"]["display_name"]: path for path in paths}

    def open_tab(self, tab: str) -> None:
        """Bring a tab to the front, by what the layout calls it."""
        layout = self._layout()
        path, root = _tabbed(layout)
        layout[path]["ContainerBlueprint"] = {**root, "active_tab": tab}
        self._client.set_blueprint(layout, "recording")

    def _layout(self) -> dict[str, Any]:
        return self._client.get_blueprint("recording").blueprint


def _tabbed(layout: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """The container of the tabs, its path first; one without any if there is none."""
    for path, archetypes in layout.items():
        container = archetypes.get("ContainerBlueprint", {})
        if container.get("container_kind") == "Tabs":
            return path, container
    return "", {}
