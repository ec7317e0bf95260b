"""``tpgmm demo``: the paper's experiment, and its table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

__all__ = ["app"]

app = typer.Typer()

#: Heading, entry of the metrics, figures shown, and their format.
COLUMNS = (
    ("grasp\nmm", "grasp position error [mm]", ("median", "p95"), ".2f"),
    ("grasp\ndeg", "grasp orientation error [deg]", ("median", "p95"), ".2f"),
    ("shoulder\nRMSE rad", "shoulder RMSE [rad]", ("median", "p95"), ".3f"),
    ("freq.\n%", "frequency error [%]", ("median", "p95"), ".1f"),
    ("ampl.\n%", "amplitude error [%]", ("median", "p95"), ".1f"),
    ("first\nstep rad", "first step [rad]", ("max",), ".3f"),
    ("beyond\nlimits rad", "beyond joint limits [rad]", ("max",), ".2g"),
    ("speed\nrad/s", "joint speed [rad/s]", ("max",), ".2f"),
    ("accel.\nrad/s^2", "joint acceleration [rad/s^2]", ("median", "max"), ".0f"),
)
ORIENTATION = "grasp orientation error [deg]"


@app.command(epilog="Example: tpgmm demo --out out/demo --n-components 20")
def demo(
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Where data set, model and figures go.")
    ] = Path("out/demo"),
    n_components: Annotated[int, typer.Option(min=1, help="K, the number of Gaussians.")] = 30,
    n_demonstrations: Annotated[
        int, typer.Option(min=1, help="Demonstrations to learn from.")
    ] = 10,
    n_situations: Annotated[
        int, typer.Option(min=1, help="Bottle poses and start postures to reproduce for.")
    ] = 50,
    random_state: Annotated[int, typer.Option(min=0, help="Seed of all that is random.")] = 0,
    rate: Annotated[
        int, typer.Option(min=1, help="Time steps per second; fewer are quicker and coarser.")
    ] = 100,
) -> None:
    """Run the paper's experiment: ten demonstrations of shaking a bottle with two hands.

    Generates demonstrations, writes them as a LeRobot data set and reads it back, aligns and
    learns them, reproduces the skill for bottle poses never seen, measures how well, and draws
    the paper's figures 3 to 6.
    """
    from rich.console import Console

    from tpgmm_datasets.bottle_experiment import BottleExperiment
    from tpgmm_datasets.bottle_shaking import BottleShaking

    console = Console()
    with _progress(console, BottleExperiment.STAGES) as report:
        metrics = BottleExperiment(
            out,
            n_components=n_components,
            n_demonstrations=n_demonstrations,
            n_situations=n_situations,
            seed=random_state,
            report=report,
            skill=BottleShaking(rate=rate),
        ).run()
    console.print(table(metrics["rows"], metrics["demonstrations"]))
    for line in summary(metrics):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    console.print(
        f"{metrics['seconds']:.0f} s; data set, model, figures and metrics.json in {out}",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )


@contextmanager
def _progress(console: Console, stages: int) -> Iterator[Callable[[str], None]]:
    """A bar on a terminal, a line per stage elsewhere."""
    if not console.is_terminal:
        yield lambda text: typer.echo(f"{text} ...")
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("starting", total=stages, completed=-1)

        def report(text: str) -> None:
            bar.update(task, description=text, advance=1)

        yield report
        bar.update(task, description="done", completed=stages)


def table(rows: Mapping[str, Mapping[str, Any]], demonstrations: Mapping[str, Any]) -> Table:
    """The metrics as a table of at most 100 columns.

    Parameters
    ----------
    rows : mapping of str to mapping
        By name of the method, ``metrics["rows"]``.
    demonstrations : mapping
        The demonstrations' own, ``metrics["demonstrations"]``.
    """
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    shown = Table(
        box=SIMPLE_HEAD,
        padding=0,
        pad_edge=False,
        caption="median / 95th percentile; steps, limits and speed: worst; "
        "acceleration: median / worst",
        caption_justify="left",
    )
    shown.add_column("")
    for heading, *_ in COLUMNS:
        shown.add_column(heading, justify="right", no_wrap=True)
    for name, row in {**rows, "demonstrations": demonstrations}.items():
        cells = [_cell(row.get(key), parts, style) for _, key, parts, style in COLUMNS]
        shown.add_row(name.replace(", ", ",\n"), *cells)
    return shown


def _cell(value: Any, parts: tuple[str, ...], style: str) -> str:
    if value is None:
        return "-"
    if isinstance(value, Mapping):
        return "/".join(format(value[part], style) for part in parts)
    return format(value, style)


def summary(metrics: Mapping[str, Any]) -> Iterator[str]:
    """What the table does not say, in sentences.

    Parameters
    ----------
    metrics : mapping
        What the experiment returns.
    """
    for name, share in metrics["share of information on the shoulders"].items():
        yield f"share of the information on the shoulders, {name}: {100 * share:.1f} %"
    rows = metrics["rows"]
    full, ablated = next(iter(rows.values())), rows.get("position only")
    if ablated is not None:
        ratio = ablated[ORIENTATION]["median"] / full[ORIENTATION]["median"]
        yield f"without orientation its error at the grasp is {ratio:.0f} times as large"
