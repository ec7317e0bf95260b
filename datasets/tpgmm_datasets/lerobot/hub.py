"""Where a data set is on this machine: a folder, or a copy from the Hugging Face hub."""

from __future__ import annotations

import glob
import os
import re
from pathlib import Path

from tpgmm_datasets.errors import DatasetError
from tpgmm_torch.exceptions import DependencyError

__all__ = ["local_folder"]

#: What is fetched: no videos.
PATTERNS = ["meta/**", "data/**"]


def local_folder(path: str | Path) -> Path:
    """The folder of a data set.

    Parameters
    ----------
    path : str or Path
        A folder, or an id ``owner/name`` on the hub. An id is looked up in LeRobot's own
        cache, then fetched through ``huggingface_hub`` (which looks into its cache first, and
        only there when offline).

    Raises
    ------
    DatasetError
        If there is no such folder and no such data set in reach.
    DependencyError
        If it is an id and huggingface_hub is not installed.
    """
    folder = Path(path)
    if folder.is_dir():
        return folder
    if isinstance(path, Path) or not re.fullmatch(r"[\w.-]+/[\w.-]+", path):
        kept = list(folder.parent.glob(f".{glob.escape(folder.name)}.*.previous"))
        hint = (
            f"; a write was interrupted, the old set is in {kept[0]}: rename it" if kept else ""
        )
        raise DatasetError(f"there is no folder {folder}{hint}", check="missing")
    home = os.environ.get("HF_HOME", Path.home() / ".cache" / "huggingface")
    recorded = Path(os.environ.get("HF_LEROBOT_HOME", Path(home) / "lerobot")) / path
    if (recorded / "meta" / "info.json").is_file():
        return recorded
    return _fetch(path)


def _fetch(repo_id: str) -> Path:
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise DependencyError(
            f"there is no folder {repo_id!r}; to fetch the data set of that id from the "
            "Hugging Face hub, pip install huggingface_hub"
        ) from error
    # its errors are many classes: offline, not found, no access, no connection
    try:
        return Path(snapshot_download(repo_id, repo_type="dataset", allow_patterns=PATTERNS))
    except Exception as error:
        raise DatasetError(
            f"there is no folder {repo_id!r}, and the data set of that id is neither in the "
            f"local Hugging Face cache nor in reach ({type(error).__name__}). Where there is "
            f"a connection: hf download --repo-type dataset {repo_id} --include 'meta/*' "
            "'data/*'; then copy the cache, or pass the folder"
        ) from error
