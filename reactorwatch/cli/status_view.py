"""Status of plants as text for people: values, nodes, alarms."""

from collections.abc import Sequence
from typing import Any

from reactorwatch.cli.alarm_rows import Now, advise_acknowledgement, alarm_rows
from reactorwatch.cli.display import (
    ATTENTION,
    FAINT,
    RIGHT,
    STRONG,
    WRONG,
    Cell,
    Row,
    format_age,
    format_report,
    format_rows,
)
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.contract.promise_text import describe_power

_INDENT = 2


def format_plant(
    plant: dict[str, Any], alarms: Sequence[Alarm], now: Now, *, width: int | None = None, colour: bool = False
) -> str:
    """Format the status of a plant.

    Args:
        plant: the object that `status --json` prints for it.
        alarms: its annunciated alarms.
        now: its present times.
        width: see `format_rows`.
        colour: see `format_rows`.
    """
    parts = [format_rows([_values(plant)], width=width, colour=colour)]
    nodes = [_node(node) for node in plant["nodes"]]
    parts.append(format_rows(nodes or [("no nodes",)], _INDENT, width=width, colour=colour))
    promise = format_rows(_promise(plant), _INDENT, colour=colour and width is None)
    parts.append(promise if width is None else format_report(promise.split("\n"), width, colour=colour))
    if alarms:
        parts.append(format_rows(alarm_rows(alarms, now), _INDENT, width=width, colour=colour))
        advice = advise_acknowledgement(alarms, plant["plant"])
        parts.append(format_rows([(Cell(advice, FAINT),)] if advice else [], _INDENT, width=width, colour=colour))
    else:
        parts.append(format_rows([(Cell("no alarms", RIGHT),)], _INDENT, width=width, colour=colour))
    return "\n".join(filter(None, parts))


def _values(plant: dict[str, Any]) -> Row:
    """Name of the plant, the newest value of each signal, and the rate of samples."""
    cells: list[Cell | str] = [Cell(plant["plant"], STRONG)]
    missing = []
    for name, signal in plant["signals"].items():
        if signal["value"] is None:
            missing.append(name)
        else:
            cells.append(f"{name} {signal['value']:.5g} {signal['unit'] or ''}".rstrip())
    if missing:
        cells.append(Cell(f"no {', '.join(missing)}", WRONG))
    rate = plant["samples_per_s"]
    return (*cells, *([] if rate is None else [Cell(f"{rate:.3g} samples/s", FAINT if rate else WRONG)]))


def _promise(plant: dict[str, Any]) -> list[Row]:
    """Promise of false alarms and the power, if they are known."""
    promise = plant["promise"]
    if promise is None:
        return []
    is_good = promise["kept"] and not promise["drifted"]
    rows: list[Row] = [("promise", Cell(promise["text"], "" if is_good else ATTENTION))]
    if plant["power"]:
        rows.append(("seen in an hour", Cell(describe_power(plant["power"]), FAINT)))
    return rows


def _node(node: dict[str, Any]) -> Row:
    if (why := node.get("waiting_for")) is not None:
        return (node["node"], Cell(f"{node['phase']}: {why}", WRONG), _age(node))
    if not node["alive"]:
        return (node["node"], Cell("not there", WRONG), _age(node))
    phase = node.get("phase", "")
    if "training" in node:
        phase += f" {100 * node['training']:.0f} %"
    elif "reference" in node:
        phase += f" by {node['reference']}"
    lag = f"lag {node['lag_ms']:.1f} ms" if "lag_ms" in node else ""
    return (
        node["node"],
        Cell(phase, ATTENTION if "training" in node else ""),
        _age(node),
        *(_count(node, name) for name in ("lost", "refused")),
        lag,
    )


def _count(node: dict[str, Any], name: str) -> Cell:
    if name not in node:
        return Cell("")
    return Cell(f"{name} {node[name]}", ATTENTION if node[name] else FAINT)


def _age(node: dict[str, Any]) -> Cell:
    return Cell(f"{format_age(node['said_s_ago'])} ago" if "said_s_ago" in node else "", FAINT)
