"""What is refused: by the error itself, ours and a builtin, in words that help."""

import re
from collections.abc import Callable

import pytest

from tpgmm_torch.exceptions import TPGMMError

__all__ = ["refused"]


def refused(call: Callable[[], object], error: type[Exception], *patterns: str) -> None:
    """Hold that ``call`` raises ``error`` itself, whose message fits every pattern.

    An error of ours has to be a builtin one, too: whoever catches that shall be served.
    """
    with pytest.raises(error) as caught:
        call()
    if issubclass(error, TPGMMError):
        builtin = (KeyError, ValueError, OSError, RuntimeError, ImportError)
        assert type(caught.value) is error and issubclass(error, builtin)
    missing = [one for one in patterns if not re.search(one, str(caught.value))]
    assert not missing, f"{missing} not in {caught.value}"
