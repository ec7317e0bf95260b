"""``tpgmm app``: the page in the browser."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import TYPE_CHECKING

import typer

from tpgmm_tools.arguments import options

if TYPE_CHECKING:
    from tpgmm_tools.app.sources import Recorded


app = typer.Typer(add_completion=False)

#: Largest file that may be uploaded.
LARGEST = "500mb"
#: Fonts of the browser; gradio's own would be fetched from elsewhere.
FONTS = ("ui-sans-serif", "system-ui", "sans-serif")
EXAMPLE = (
    "tpgmm app\n\n"
    "Example: tpgmm app out/demo/dataset --robot upper_body --link l_hand --link r_hand"
)


@options.command(app, EXAMPLE)
def page(
    dataset: str | None = None,
    *,
    described: options.RobotOptions,
    data: options.DataOptions,
    host: str = "127.0.0.1",
    port: int = 7860,
) -> None:
    """Learn and look in the browser: a data set in, a moving picture out.

    Serves a page on which recordings are chosen or uploaded, learned, and reproduced with
    objects elsewhere; what is implausible is said in words. Needs the extra 'app'.

    Parameters
    ----------
    dataset : ``DATASET``
        A LeRobot data set that is offered beside the generated one; others can be uploaded.
    host : str
        Address to listen on; who reaches it can have anything learned.
    port : int >= 0
        Port; 0 for any that is free.
    """
    import torch

    from tpgmm_tools.app.page import page as built

    # the matrices are small: a second thread on a busy machine only spins
    torch.set_num_threads(1)
    kinematics = described.read()
    if dataset is None and kinematics is not None:
        raise options.refuse("--robot describes DATASET, and none is given")

    def read_recorded() -> Recorded:
        return data.read(str(dataset), kinematics), kinematics

    blocks = built({} if dataset is None else {dataset: read_recorded})
    from gradio.themes import Default

    _, url, _ = blocks.launch(
        server_name=host,
        server_port=port or None,
        max_file_size=LARGEST,
        quiet=True,
        prevent_thread_lock=True,
        ssr_mode=False,
        theme=Default(font=FONTS, font_mono=("ui-monospace", "monospace")),
    )
    with suppress(KeyboardInterrupt):
        typer.echo(f"open {url} in a browser; stop with Ctrl-C")
        while True:
            time.sleep(1.0)
    blocks.close(verbose=False)
