"""``tpgmm demo``: the paper's experiment, and its table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tpgmm_tools.cli import options

if TYPE_CHECKING:
    from rich.table import Table

__all__ = ["app"]

app = typer.Typer(add_completion=False)

#: Heading, entry of the metrics, figures shown, digits behind the point.
COLUMNS = (
    ("grasp\nmm", "grasp position error [mm]", ("median", "p95"), 2),
    ("grasp\ndeg", "grasp orientation error [deg]", ("median", "p95"), 3),
    ("shoulder\nRMSE rad", "shoulder RMSE [rad]", ("median", "p95"), 3),
    ("freq.\n%", "frequency error [%]", ("median", "p95"), 1),
    ("ampl.\n%", "amplitude error [%]", ("median", "p95"), 1),
    ("first\nstep", "first step [rad]", ("max",), 3),
    ("beyond\nlimit", "beyond joint limits [rad]", ("max",), 3),
    ("speed\nrad/s", "joint speed [rad/s]", ("max",), 2),
    ("accel.\nrad/s^2", "joint acceleration [rad/s^2]", ("median", "max"), 1),
)
CAPTION = (
    "median/95th percentile; first step and limits (rad) and speed: worst; accel.: median/worst"
)
ORIENTATION = "grasp orientation error [deg]"


@options.command(app, "tpgmm demo --out out/demo --n-components 20")
def demo(
    *,
    out: Path = Path("out/demo"),
    n_components: int = 30,
    n_demonstrations: int = 10,
    n_situations: int = 50,
    random_state: int = 0,
    rate: int = 100,
) -> None:
    """Run the paper's experiment: ten demonstrations of shaking a bottle with two hands.

    Generates demonstrations, writes them as a LeRobot data set and reads it back, aligns and
    learns them, reproduces the skill for bottle poses never seen, measures how well, and draws
    the paper's figures 3 to 6.

    Parameters
    ----------
    out : ``DIR``
        Where data set, model and figures go.
    n_components : int >= 1
        K, the number of Gaussians.
    n_demonstrations : int >= 1
        Demonstrations to learn from.
    n_situations : int >= 1
        Bottle poses and start postures to reproduce for.
    random_state : int >= 0
        Seed of all that is random.
    rate : int >= 1
        Time steps per second; fewer are quicker and coarser.
    """
    import torch
    from rich.console import Console

    from tpgmm_datasets.bottle.experiment import BottleExperiment
    from tpgmm_datasets.bottle.skill import BottleShaking

    # the matrices are small: a second thread on a busy machine only spins
    torch.set_num_threads(1)
    metrics = BottleExperiment(
        out,
        n_components=n_components,
        n_demonstrations=n_demonstrations,
        n_situations=n_situations,
        seed=random_state,
        report=lambda text: typer.echo(f"{text} ..."),
        skill=BottleShaking(rate=rate),
    ).run()
    shown = table(metrics["rows"], metrics["demonstrations"])
    Console(width=max(Console().width, 100)).print(shown)
    for line in summary(metrics):
        typer.echo(line)
    typer.echo(
        f"seed {random_state}, {metrics['seconds']:.0f} s; "
        f"data set, model, figures and metrics.json in {out}"
    )


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
        box=SIMPLE_HEAD, padding=0, pad_edge=False, caption=CAPTION, caption_justify="left"
    )
    shown.add_column("", no_wrap=True)
    for heading, *_ in COLUMNS:
        shown.add_column(heading, justify="right", no_wrap=True)
    for name, row in {**rows, "demonstrations": demonstrations}.items():
        cells = [_cell(row.get(key), parts, digits) for _, key, parts, digits in COLUMNS]
        shown.add_row(name.replace(", ", ",\n"), *cells)
    return shown


def _cell(value: Any, parts: tuple[str, ...], digits: int) -> str:
    if value is None:
        return "-"
    numbers = [value[part] for part in parts] if isinstance(value, Mapping) else [value]
    return "/".join(f"{number:.{digits if number < 10 else 0}f}" for number in numbers)


def summary(metrics: Mapping[str, Any]) -> Iterator[str]:
    """Shares, ratios and alignment, in sentences.

    Parameters
    ----------
    metrics : mapping
        As the experiment returns them.
    """
    for name, share in metrics["share of information on the shoulders"].items():
        yield f"share of the information on the shoulders, {name}: {100 * share:.1f} %"
    full, ablated = next(iter(metrics["rows"].values())), metrics["rows"]["position only"]
    ratio = ablated[ORIENTATION]["median"] / full[ORIENTATION]["median"]
    yield f"orientation error at the grasp if positions alone are learned: {ratio:.3g} times"
    for name, measures in metrics["alignment"].items():
        figures = ", ".join(f"{measure} {value:.3g}" for measure, value in measures.items())
        yield f"alignment, {name}: {figures}"
