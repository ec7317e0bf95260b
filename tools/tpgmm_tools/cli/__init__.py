"""The command ``tpgmm``.

All modules import the toolkit inside their commands: ``tpgmm COMMAND --help`` is quick.
"""

import sys

__all__ = ["main"]


def main() -> None:
    """Run the command line: the entry point ``tpgmm``."""
    try:
        from tpgmm_tools.cli.application import app
    except ModuleNotFoundError as error:
        if error.name not in ("typer", "rich"):
            raise
        sys.exit(f"tpgmm: the command line needs {error.name}: pip install 'tpgmm-torch[cli]'")
    app()
