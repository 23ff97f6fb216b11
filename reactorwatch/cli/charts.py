"""Control charts: how long they run, and which is fastest."""

from typing import Annotated

from typer import Argument, Option

from reactorwatch.cli.option_groups import new_group
from reactorwatch.cli.options import Json
from reactorwatch.cli.printing import json_line, print_lines, print_text
from reactorwatch.errors import InputError

Shift = Annotated[float, Option(help="Of the mean, in standard deviations; 0: the false alarms.")]
SteadyState = Annotated[bool, Option("--steady-state", help="The chart has long run when the shift comes.")]
Rules = Annotated[str, Option(help="Run rules, some of 1,2,3,4.")]
Dimension = Annotated[int, Option(help="Number of signals.")]
Weight = Annotated[float, Option("--lambda", help="Weight of the newest sample.")]


def shewhart(
    shift: Shift = 0.0,
    rules: Rules = "1",
    limit: Annotated[float, Option(help="Width L of the outer lines, in standard deviations.")] = 3.0,
    steady_state: SteadyState = False,
    as_json: Json = False,
) -> None:
    """Individual values, with run rules."""
    from reactorwatch.spc.charts.shewhart import shewhart_run_length

    length = shewhart_run_length(shift, limit, _rules(rules), steady_state=steady_state)
    _print_length(length, as_json, chart="shewhart", rules=list(_rules(rules)), limit=limit, shift=shift)


def cusum(
    k: Annotated[float, Option(help="Allowance, in standard deviations.")],
    h: Annotated[float, Option(help="Limit, in standard deviations.")],
    shift: Shift = 0.0,
    headstart: Annotated[float, Option(help="Where the sums start, in standard deviations.")] = 0.0,
    one_sided: Annotated[bool, Option("--one-sided", help="The high sum only.")] = False,
    steady_state: SteadyState = False,
    as_json: Json = False,
) -> None:
    """Two-sided cumulative sums."""
    from reactorwatch.spc.charts.cusum import cusum_run_length

    length = cusum_run_length(shift, k, h, headstart, one_sided=one_sided, steady_state=steady_state)
    _print_length(length, as_json, chart="cusum", k=k, h=h, headstart=headstart, shift=shift)


def ewma(
    weight: Weight,
    limit: Annotated[float, Option(help="L, in standard deviations of the average.")],
    shift: Shift = 0.0,
    exact_limits: Annotated[bool, Option("--exact-limits", help="Limits that widen from the start.")] = False,
    steady_state: SteadyState = False,
    as_json: Json = False,
) -> None:
    """Exponentially weighted moving average."""
    from reactorwatch.spc.charts.ewma import ewma_run_length

    length = ewma_run_length(shift, weight, limit, exact_limits=exact_limits, steady_state=steady_state)
    _print_length(length, as_json, chart="ewma", **{"lambda": weight}, limit=limit, shift=shift)


def mewma(
    dimension: Annotated[int, Option(help="Number of signals.")],
    weight: Weight,
    limit: Annotated[float, Option(help="H, of the statistic.")],
    shift: Shift = 0.0,
    steady_state: SteadyState = False,
    as_json: Json = False,
) -> None:
    """Moving average of several signals."""
    from reactorwatch.spc.charts.mewma import mewma_run_length

    length = mewma_run_length(shift, dimension, weight, limit, steady_state=steady_state)
    _print_length(length, as_json, chart="mewma", dimension=dimension, **{"lambda": weight}, limit=limit, shift=shift)


def t2(
    dimension: Annotated[int, Option(help="Number of signals.")],
    limit: Annotated[float, Option(help="Of T2.")],
    shift: Shift = 0.0,
    steady_state: SteadyState = False,
    as_json: Json = False,
) -> None:
    """Hotelling's T2, known covariance; it has no memory, so its steady state is as any other."""
    from reactorwatch.spc.charts.t2 import t2_run_length

    _print_length(
        t2_run_length(shift, dimension, limit), as_json, chart="t2", dimension=dimension, limit=limit, shift=shift
    )


def list_charts() -> None:
    """List the charts of a monitor, with their keys in its settings."""
    from reactorwatch.spc.charts.base import Setting
    from reactorwatch.spc.charts.catalogue import CHARTS

    for kind in CHARTS:
        print_text(f"{kind.name:<11} {(kind.__doc__ or '').partition(chr(10))[0]}")
        for item in kind.settings:
            if isinstance(item, Setting):
                print_text(f"{'':<11} {item.key} = {item.default:g}, in [{item.lower:g}, {item.upper:g}]")
            else:
                print_text(f"{'':<11} {item.key}: at most {item.most} of the signals")


def design(
    chart: Annotated[str, Argument(help="shewhart, ewma, cusum, t2 or mewma.")],
    arl0: Annotated[float, Option(help="Samples to a false alarm, on average.")],
    shift: Annotated[float, Option(help="To be detected, in standard deviations.")],
    dimension: Dimension = 2,
    rules: Rules = "1",
    as_json: Json = False,
) -> None:
    """The chart that detects a shift fastest at a rate of false alarms."""
    from reactorwatch.spc.charts.catalogue import CHARTS
    from reactorwatch.spc.run_length import check_design

    kinds = {kind.name: kind for kind in CHARTS if "fastest" in vars(kind)}
    if chart not in kinds:
        raise InputError(f"chart must be one of {', '.join(kinds)}, got {chart!r}")
    check_design(arl0, shift, dimension)
    found = kinds[chart].fastest(arl0, shift, dimension, _rules(rules))
    if as_json:
        print_lines(json_line(found))
        return
    print_lines(chart)
    for name, value in found.parameters.items():
        text = ",".join(map(str, value)) if isinstance(value, list) else f"{value:.6g}"
        print_lines(f"  {name:<10} {text}")
    print_lines(f"false alarm every {found.arl0:g} samples; a shift of {found.shift:g} is seen after {found.arl:.4g}")


def _rules(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(rule) for rule in text.split(","))
    except ValueError:
        raise InputError(f"--rules must be some of 1,2,3,4 with commas between, got {text!r}") from None


def _print_length(length: float, as_json: bool, **chart: object) -> None:
    """Print the run length: one number, or one object with the chart's parameters."""
    if not as_json:
        print_lines(f"{length:.8g}")
        return
    print_lines(json_line({**chart, "arl": length}))


charts = new_group({"design": design, "list": list_charts})
charts.add_typer(
    new_group({"shewhart": shewhart, "cusum": cusum, "ewma": ewma, "mewma": mewma, "t2": t2}),
    name="arl",
    help="The average run length of a chart, in samples.",
)
