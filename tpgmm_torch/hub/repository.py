"""Push models to repositories of the Hugging Face hub, and load them from there."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tpgmm_torch import persistence
from tpgmm_torch.estimator import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, DependencyError, ModelFileError
from tpgmm_torch.hub.model_card import model_card
from tpgmm_torch.persistence import FILES, save
from tpgmm_torch.skills.skill import Skill

__all__ = ["load", "push"]

#: As the hub has them: an owner, and a name.
REPOSITORY = re.compile(r"\w[\w.-]*/\w[\w.-]*", re.ASCII)


def push(
    model: TaskParameterizedGMM | Skill,
    repo_id: str,
    *,
    measured: Mapping[str, object] | None = None,
    notes: str = "",
    license: str | None = None,
    private: bool | None = None,
    token: str | None = None,
) -> str:
    """Upload a fitted model or a skill to the Hugging Face hub, with a card made from it.

    The ranges of postures and frames in the demonstrations and the robot's URDF go along, the
    demonstrations do not.

    Parameters
    ----------
    model : TaskParameterizedGMM or Skill
        Fitted.
    repo_id : str
        ``"owner/name"``; made if it does not exist.
    measured, notes, license : mapping of str to object, str, str, optional
        For the card, see :func:`model_card`.
    private : bool, optional
        Whether a repository that is made is private; by default as its owner has it.
    token : str, optional
        By default the one of ``hf auth login``.

    Returns
    -------
    str
        Address of the commit.

    Raises
    ------
    NotFittedError, ModelFileError
        If the model is not fitted, or cannot be saved.
    DataError, DependencyError
        If that is no repository's id, or huggingface_hub is not installed.
    """
    card = model_card(model, repo_id, measured=measured, notes=notes, license=license)
    return upload(repo_id, partial(save, model), card, private=private, token=token)


def load(
    repo_id_or_folder: str | Path,
    *,
    revision: str | None = None,
    token: str | None = None,
    custom: Sequence[type] = (),
    device: str | None = None,
) -> TaskParameterizedGMM | Skill:
    """Load a model or a skill from the Hugging Face hub, or a folder; nothing is executed.

    Parameters
    ----------
    repo_id_or_folder : str or Path
        ``"owner/name"``, or a folder, which is preferred if it is there.
    revision : str, optional
        Branch, tag or commit.
    token : str, optional
        By default the one of ``hf auth login``.
    custom, device : sequence of type, str, optional
        As for :func:`tpgmm_torch.load`.

    Raises
    ------
    ModelFileError, DependencyError
        If there is no such model, or huggingface_hub is not installed.
    """
    folder = download(repo_id_or_folder, FILES, revision=revision, token=token)
    return persistence.load(folder, custom, device)


def upload(
    repo_id: str,
    write: Callable[[Path], object],
    card: str,
    *,
    private: bool | None = None,
    token: str | None = None,
    message: str = "Upload model",
) -> str:
    """Write a folder and a card, and upload both in one commit.

    Parameters
    ----------
    repo_id : str
        ``"owner/name"``; made if it does not exist.
    write : callable
        Called with a folder that does not exist yet: makes it.
    card : str
        Of the repository, its README.md.
    private : bool, optional
        Whether a repository that is made is private; by default as its owner has it.
    token : str, optional
        By default the one of ``hf auth login``.
    message : str
        Of the commit.

    Returns
    -------
    str
        Where it is.

    Raises
    ------
    DataError, DependencyError
        If that is no repository's id, or huggingface_hub is not installed.
    """
    if not REPOSITORY.fullmatch(repo_id):
        raise DataError(f"a repository is written 'owner/name', got {repo_id!r}")
    api = _hub().HfApi(token=token)
    with TemporaryDirectory() as place:
        folder = Path(place) / "model"
        write(folder)
        (folder / "README.md").write_text(card, encoding="utf-8")
        api.create_repo(repo_id, private=private, exist_ok=True)
        commit = api.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=message)
    return str(commit.commit_url)


def download(
    repo_id_or_folder: str | Path,
    files: Sequence[str],
    *,
    revision: str | None = None,
    token: str | None = None,
) -> Path:
    """Fetch some files of a repository into a folder; return one that is there already.

    Parameters
    ----------
    repo_id_or_folder : str or Path
        ``"owner/name"``, or a folder. One that is missing and cannot be an id is not looked up.
    files : sequence of str
        Their names; no other is fetched.
    revision : str, optional
        Branch, tag or commit.
    token : str, optional
        By default the one of ``hf auth login``.

    Raises
    ------
    ModelFileError, DependencyError
        If there is no such folder and no such repository, or huggingface_hub is not installed.
    """
    if Path(repo_id_or_folder).is_dir():
        return Path(repo_id_or_folder)
    if isinstance(repo_id_or_folder, Path) or not REPOSITORY.fullmatch(repo_id_or_folder):
        raise ModelFileError(
            f"there is no folder {str(repo_id_or_folder)!r}, and a repository is written "
            "'owner/name'"
        )
    fetch = _hub().snapshot_download
    options: dict[str, Any] = {"revision": revision, "token": token}
    try:
        return Path(fetch(repo_id_or_folder, allow_patterns=list(files), **options))
    except (OSError, ValueError) as error:  # what is not there, not allowed, or not reached
        raise ModelFileError(
            f"there is no folder {repo_id_or_folder!r}, and the repository of that name cannot "
            f"be fetched: {error}"
        ) from error


def _hub() -> Any:
    try:
        import huggingface_hub
    except ImportError as error:
        raise DependencyError(
            "the hub needs huggingface_hub: pip install 'tpgmm-torch[hub]'"
        ) from error
    return huggingface_hub
