"""``tpgmm sequence``: skills one after the other, as one skill."""

from __future__ import annotations

from pathlib import Path

import typer

from tpgmm_tools.arguments import options
from tpgmm_tools.arguments.plugins import OWN, model_format

app = typer.Typer()

EXAMPLE = 'tpgmm sequence "out/pick until held retry 2, out/home until arrived" --out out/all'


@options.command(app, EXAMPLE)
def sequence(
    text: str,
    *,
    out: Path,
    fade: float = 1.0,
    timeout: float = 2.0,
    format_: str = OWN,
    dataset: str | None = None,
) -> None:
    """Join skills that were learned separately.

    Each goes on to the next one when what it is to end with is seen; if that does not come, it
    is tried again from where robot and objects are then.

    Parameters
    ----------
    text : ``SKILLS``
        Folders of models, separated by commas: 'DIR [until CONDITION] [retry NUMBER [from
        NAME]], ...'. A condition is arrived, held, free or contact:LINK, or several joined by
        +; NAME is the last part of a folder before.
    out : ``DIR``
        Where the sequence goes.
    fade : float > 0
        Seconds from the end of one skill to the beginning of the next.
    timeout : float > 0
        Seconds for which the end of a skill is waited for before it is tried again.
    format_ : ``tpgmm | lerobot``
        'lerobot' for one policy that lerobot-rollout takes.
    dataset : str
        For --format lerobot, the LeRobot data set whose states, actions and rate it has.
    """
    from tpgmm_datasets.signals import Signals
    from tpgmm_torch.persistence import load_skill, save
    from tpgmm_torch.skills.sequence import Sequence

    write = model_format(format_)
    if (write is None) != (dataset is None):
        raise options.refuse(
            "--format lerobot and --dataset go together: a policy's signals are its"
        )
    made = Sequence.parse(text, load_skill, fade=fade, timeout=timeout)
    if write is None:
        save(made, out)
    else:
        assert dataset is not None
        write(made, out, Signals.of(dataset, made.kinematics))
    for gate in made.gates:
        until = " and ".join(map(str, gate.until)) or "no condition"
        typer.echo(f"{gate.time:6.2f} s  end of {gate.name}: {until}, {gate.retries} retries")
    typer.echo(f"{made.end:6.2f} s  end; saved {out}")
