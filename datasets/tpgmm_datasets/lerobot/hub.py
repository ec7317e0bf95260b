"""Where a data set is on this machine: a folder, or a copy from the Hugging Face hub."""

from __future__ import annotations

import os
import re
from pathlib import Path

from tpgmm_datasets.errors import DatasetError
from tpgmm_torch.atomic import recover
from tpgmm_torch.exceptions import DependencyError

#: How a name says that it is the hub's, as in huggingface_hub's own paths.
HUB = "hf://datasets/"
REPO_ID = r"[\w.-]+/[\w.-]+"
#: What is fetched: no videos.
PATTERNS = ["meta/**", "data/**"]


def local_folder(path: str | Path) -> Path:
    """Find the folder of a data set.

    Parameters
    ----------
    path : str or Path
        A folder; an id ``OWNER/NAME`` of a set that LeRobot keeps on this machine (in
        ``HF_LEROBOT_HOME``); or ``hf://datasets/OWNER/NAME``, which is fetched from the hub
        through ``huggingface_hub`` (it looks into its cache first, and only there when
        offline). Nothing else is: a misspelt folder must not become a stranger's data.

    Raises
    ------
    DatasetError
        If there is no such folder and no such data set in reach.
    DependencyError
        If it is on the hub and huggingface_hub is not installed.
    """
    if isinstance(path, str) and "://" in path:
        asked = re.fullmatch(rf"{HUB}({REPO_ID})", path)
        if asked is None:
            raise DatasetError(f"{path!r} is neither a folder nor {HUB}OWNER/NAME")
        return _fetch(asked[1])
    folder = Path(path)
    recover(folder)
    if folder.is_dir():
        return folder
    hint = ", but a file: save_lerobot makes a set of what read_table reads" * folder.is_file()
    if isinstance(path, str) and re.fullmatch(REPO_ID, path):
        home = os.environ.get("HF_HOME", Path.home() / ".cache" / "huggingface")
        recorded = Path(os.environ.get("HF_LEROBOT_HOME", Path(home) / "lerobot")) / path
        if (recorded / "meta" / "info.json").is_file():
            return recorded
        hint = f", nor {recorded}. A data set of that id on the Hugging Face hub is {HUB}{path}"
    raise DatasetError(f"there is no folder {folder}{hint}", check="missing")


def _fetch(repo_id: str) -> Path:
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        fetched = f"to fetch the data set {repo_id!r} from the Hugging Face hub"
        raise DependencyError(f"{fetched}, pip install huggingface_hub") from error
    # its errors are many classes: offline, not found, no access, no connection
    try:
        return Path(snapshot_download(repo_id, repo_type="dataset", allow_patterns=PATTERNS))
    except Exception as error:
        raise DatasetError(
            f"the data set {repo_id!r} is neither in the local Hugging Face cache nor in reach "
            f"({type(error).__name__}). Where there is a connection: hf download --repo-type "
            f"dataset {repo_id} --include 'meta/*' 'data/*'; then copy its cache"
        ) from error
