"""One finding about all places at which something was found."""

from collections.abc import Iterator, Sequence
from math import nan

from tpgmm_torch.checks.report import Finding, shorten_list

Findings = Iterator[Finding]
#: What is said of it, its demonstration, and its joint or frame, empty if it has none.
Place = tuple[str, int, str]


def report_at(
    check: str, message: str, remedy: str, places: Sequence[Place], value: float = nan
) -> Findings:
    """Report some places as one finding, if there are any.

    Parameters
    ----------
    check, message, remedy : str
        As of :class:`~tpgmm_torch.checks.report.Finding`; the message goes on with the places.
    places : sequence of (str, int, str)
        As :data:`Place` says.
    value : float, optional
        As of the finding.
    """
    if places:
        parts = zip(*places, strict=True)
        texts, episodes, names = (tuple(dict.fromkeys(part)) for part in parts)
        about = tuple(filter(None, names))
        yield Finding(check, f"{message} {shorten_list(texts)}", remedy, about, episodes, value)
