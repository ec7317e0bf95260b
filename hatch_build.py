"""Addresses of the project in the metadata of its wheels, where the repository is known."""

from __future__ import annotations

import os
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


class RepositoryUrls(MetadataHookInterface):
    """Fill ``[project.urls]`` from ``GITHUB_REPOSITORY`` ("OWNER/NAME"), which runners set.

    A fork so points to itself, and a build on any other machine names no address.
    """

    def update(self, metadata: dict[str, Any]) -> None:
        """Add the addresses to the metadata of ``pyproject.toml``."""
        repository = os.environ.get("GITHUB_REPOSITORY", "")
        owner, slash, name = repository.partition("/")
        if not slash:
            return
        source = f"https://github.com/{repository}"
        metadata["urls"] = {
            "Homepage": source,
            "Documentation": f"https://{owner}.github.io/{name}",
            "Issues": f"{source}/issues",
            "Changelog": f"{source}/blob/main/CHANGELOG.md",
        }
