"""``tpgmm demo``: the paper's experiment, and its table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tpgmm_tools.arguments import options

if TYPE_CHECKING:
    from rich.table import Table


app = typer.Typer(add_completion=False)

#: Heading, entry of the metrics, figures shown, digits behind the point.
COLUMNS = (
    ("grasp\nin mm", "grasp position error [mm]", ("median", "p95"), 2),
    ("grasp\nin deg", "grasp orientation error [deg]", ("median", "p95"), 3),
    ("shaking\nin rad", "shoulder RMSE [rad]", ("median", "p95"), 3),
    ("amplitude\nin %", "amplitude error [%]", ("median", "p95"), 1),
)
TITLE = "How far off: median / 95th percentile over situations that were not demonstrated"
CAPTION = """\
grasp: hands at the bottle; shaking, amplitude: shoulders. K: Gaussians.
Bold: saved. eqs (1), (2): the form that the paper prints, by its epsilon."""
#: Names of the methods for those who have not read the paper.
NAMES = (
    ("information form, ", "TP-GMM, "),
    ("covariance form, epsilon = ", "eqs (1), (2), "),
    ("position only", "without orientation"),
)
NEXT = """
Next: see it move, read one page about it, learn your own skill
  tpgmm view {out}
  tpgmm report {out}/model --dataset {out}/dataset
  tpgmm fit RECORDINGS --robot ROBOT.urdf --out MODEL"""
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
    from rich.progress import Progress

    from tpgmm_datasets.bottle.skill import BottleShaking
    from tpgmm_tools.paper.experiment import BottleExperiment

    # the matrices are small: a second thread on a busy machine only spins
    torch.set_num_threads(1)
    console = Console(width=max(Console().width, 80))
    with Progress(console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=BottleExperiment.STAGES)

        def report(text: str) -> None:
            bar.update(task, description=text, advance=1)
            if not console.is_terminal:
                typer.echo(f"{text} ...")

        metrics = BottleExperiment(
            out,
            n_components=n_components,
            n_demonstrations=n_demonstrations,
            n_situations=n_situations,
            seed=random_state,
            report=report,
            skill=BottleShaking(rate=rate),
        ).run()
    console.print(table(metrics["rows"]))
    for line in summary(metrics):
        typer.echo(line)
    typer.echo(
        f"\nData set, model, figures and metrics.json are in {out} "
        f"(seed {random_state}, {metrics['seconds']:.0f} s)."
    )
    typer.echo(NEXT.format(out=out))


def table(rows: Mapping[str, Mapping[str, Any]]) -> Table:
    """Write the metrics as a table of at most 80 columns.

    Parameters
    ----------
    rows : mapping of str to mapping
        By name of the method, ``metrics["rows"]``.
    """
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    shown = Table(box=SIMPLE_HEAD, pad_edge=False, title=TITLE, title_justify="left")
    shown.caption, shown.caption_justify = CAPTION, "left"
    shown.add_column("")
    for heading, *_ in COLUMNS:
        shown.add_column(heading, justify="right")
    for number, (name, row) in enumerate(rows.items()):
        cells = [_cell(row.get(key), parts, digits) for _, key, parts, digits in COLUMNS]
        for stored, label in NAMES:
            name = name.replace(stored, label)
        shown.add_row(name, *cells, style="bold" if number == 0 else "")
    return shown


def _cell(value: Any, parts: tuple[str, ...], digits: int) -> str:
    if value is None:
        return "-"
    numbers = [value[part] for part in parts] if isinstance(value, Mapping) else [value]
    return " / ".join(f"{number:.{digits if number < 10 else 0}f}" for number in numbers)


def summary(metrics: Mapping[str, Any]) -> Iterator[str]:
    """Say the numbers of the demo in sentences.

    Parameters
    ----------
    metrics : mapping
        As the experiment returns them.
    """
    shares = list(metrics["share of information on the shoulders"].values())
    yield (
        f"Before the grasp {100 * shares[0]:.0f} % of what is known about the shoulders comes "
        f"from the\nbottle, while shaking {100 * shares[1]:.0f} % from the joints."
    )
    ablated = metrics["rows"]["position only"][ORIENTATION]["median"]
    yield f"Without orientations the hands are turned by {ablated:.1f} deg at the grasp."
