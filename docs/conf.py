"""How Sphinx builds the documentation: ``make docs``. Needs no network."""

import sys
from fnmatch import fnmatchcase
from importlib.metadata import version as installed_version
from pathlib import Path

import torch
from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE / "pictures")]

import inventories  # noqa: E402
import notebooks  # noqa: E402

torch.set_num_threads(1)  # the matrices are small

project = "tpgmm-torch"
author = "The tpgmm-torch developers"
copyright = author
release = version = installed_version("tpgmm-torch")

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.intersphinx",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx-mathjax-offline",
    "sphinxcontrib.bibtex",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
    "myst_parser",
    "numpydoc",
    # our own
    "commands",
    "notebooks",
    "picturebook",
    "public_names",
    "sitelinks",
    "suite",
    "thumbnails",
    "ties",
    "typelinks",
]
exclude_patterns = ["_build", "_ext", "pictures", "images", "paper/*", "gallery/*.py"]
FAST = tags.has("fast")  # type: ignore[name-defined]  # noqa: F821  # make docs-fast
if FAST:
    extensions.remove("sphinx.ext.viewcode")
nitpicky = True  # see typelinks for names that exist, and are not public

# Pages
myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath", "tasklist"]
myst_heading_anchors = 3
bibtex_bibfiles = ["references.bib"]
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

# API reference
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings tell the types, with shapes and units
numpydoc_show_class_members = False
numpydoc_xref_param_type = True
numpydoc_xref_ignore = "all"  # link what is known, see typelinks
viewcode_line_numbers = True
intersphinx_mapping = inventories.write(HERE / "_build" / "inventories")

# Gallery
sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "plot_gallery": not FAST,
    "filename_pattern": r"/plot_",
    "ignore_pattern": r"^(?!plot_)",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": False,
    "only_warn_on_example_error": False,
    "capture_repr": (),
    "first_notebook_cell": notebooks.first_cell(notebooks.repository()),
    "image_scrapers": ("matplotlib",),
    "remove_config_comments": True,
    "show_memory": False,
    "show_signature": False,
    "write_computation_times": False,
    "doc_module": ("tpgmm_torch",),
    "backreferences_dir": "gallery/backreferences",
    "inspect_global_variables": False,
}
# of a row of plots, the one that says most, as shares: left, upper, right, lower
gallery_thumbnails = {
    "plot_01_planar_arm": (0.66, 0.1, 1, 1),
    "plot_02_frames_without_a_robot": (0, 0, 0.345, 0.84),
    "plot_03_orientation_sign": (0.66, 0, 1, 1),
    "plot_06_choosing": (0, 0, 0.335, 1),
    "plot_07_lerobot_dataset": (0, 0, 1, 0.4),
    "plot_08_alignment": (0, 0, 0.5, 1),
    "plot_09_covariance_along_the_path": (0, 0, 0.41, 1),
    "plot_10_own_operator": (0, 0, 0.35, 0.9),
    "plot_14_corrections": (0, 0, 0.525, 1),
    "plot_16_orientations_far_apart": (0.05, 0, 0.43, 0.86),
    "plot_17_new_to_me": (0, 0, 0.51, 1),
    "plot_18_which_goes_first": (0, 0.02, 0.412, 0.92),
}

# Site
html_theme = "pydata_sphinx_theme"
html_title = f"tpgmm-torch {release}"
html_static_path = ["_static"]
html_favicon = "_static/favicon.svg"
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
toc_object_entries_show_parents = "hide"
# pages without siblings have nothing to navigate
html_sidebars = {page.stem: [] for page in HERE.glob("*.md")}
html_context = {"default_mode": "auto"}
html_theme_options = {
    "navigation_with_keys": False,
    "header_links_before_dropdown": 8,
    "navbar_persistent": ["search-button"],  # the field would leave no room for the links
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}


def _of_others(
    app: Sphinx, what: str, name: str, member: object, *_more: object
) -> bool | None:
    """Leave out what classes inherit from scikit-learn: it is explained there."""
    method = name.rpartition(".")[2]
    theirs = str(getattr(member, "__module__", "")).startswith("sklearn.")
    return True if theirs or fnmatchcase(method, "set_*_request") else None


def setup(app: Sphinx) -> None:
    """What Sphinx calls."""
    app.connect("autodoc-skip-member", _of_others)
