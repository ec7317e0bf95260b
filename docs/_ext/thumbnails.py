"""Thumbnails of the gallery show one part of their picture, large enough to be read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from PIL import Image
from sphinx.application import Sphinx

__all__ = ["setup"]


def crop(app: Sphinx) -> None:
    """Cut each thumbnail of ``gallery_thumbnails`` out of the first picture of its example.

    The value is the part that is shown: left, upper, right and lower edge, as shares of the
    picture. Where examples are not run (``make docs-fast``) there are no pictures.
    """
    if not app.config.sphinx_gallery_conf["plot_gallery"]:
        return
    images = Path(app.srcdir) / "gallery" / "images"
    for name, part in app.config.gallery_thumbnails.items():
        with Image.open(images / f"sphx_glr_{name}_001.png") as picture:
            edges = (s * size for s, size in zip(part, picture.size * 2, strict=True))
            picture.crop(tuple(round(edge) for edge in edges)).save(
                images / "thumb" / f"sphx_glr_{name}_thumb.png"
            )


def setup(app: Sphinx) -> dict[str, Any]:
    """What Sphinx calls."""
    app.add_config_value("gallery_thumbnails", {}, "env", dict)
    app.connect("builder-inited", crop, priority=900)  # after the gallery
    return {"parallel_read_safe": True}
