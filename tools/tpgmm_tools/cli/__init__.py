"""The command ``tpgmm``.

Modules here import the toolkit inside their commands, so that ``tpgmm --help`` is quick.
"""

import sys

__all__ = ["main"]


def main() -> None:
    """Run the command line; what the entry point ``tpgmm`` calls."""
    try:
        from tpgmm_tools.cli.application import app
    except ModuleNotFoundError as error:
        if error.name not in ("typer", "rich"):
            raise
        sys.exit(f"tpgmm: the command line needs {error.name}: pip install 'tpgmm-torch[cli]'")
    app()
