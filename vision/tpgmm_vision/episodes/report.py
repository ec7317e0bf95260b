"""What was found in the episodes of a tracked set: a table, and a page with pictures."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain

import cv2
import numpy as np

from tpgmm_vision.camera import Camera
from tpgmm_vision.episodes.smoothing import Flags, Track
from tpgmm_vision.episodes.video import Picture
from tpgmm_vision.poses import Array

__all__ = ["EpisodeReport", "drawn", "report_page", "table"]

HEAD = (
    "episode", "object", "seen", "inferred", "unknown", "longest gap", "spread at rest",
    "residual", "worst",
)  # fmt: skip
#: Colours (RGB) of corners that were seen and that were expected, and the width of pictures.
SEEN_COLOUR, EXPECTED_COLOUR, WIDTH = (0, 200, 0), (255, 120, 0), 480
#: What is shown around the corners: so many times their extent, at least so many pixels.
AROUND, LEAST_AROUND = 2.0, 100
#: Fractional bits of OpenCV's drawing.
BITS = 4
#: Pictures of an episode that fit worst.
WORST = 2
STYLE = (
    "body{font:15px sans-serif;margin:2em}td,th{padding:2px 12px;text-align:right}"
    "figure{display:inline-block;margin:6px}figcaption{font-size:13px}"
)


@dataclass
class EpisodeReport:
    """What was found in an episode.

    Parameters
    ----------
    index : int
        Of the episode.
    time : ndarray of shape (T,)
        Of its rows [s].
    tracks : mapping of str to Track
        By object.
    residuals : mapping of str to ndarray of shape (T,)
        Of the corners, where they were seen [pixels].
    reasons : mapping of str to list of str
        Why it was not seen, in each row.
    pictures : list of (str, bytes)
        What is said of pictures, and these as JPEG.
    """

    index: int
    time: Array
    tracks: dict[str, Track] = field(default_factory=dict)
    residuals: dict[str, Array] = field(default_factory=dict)
    reasons: dict[str, list[str]] = field(default_factory=dict)
    pictures: list[tuple[str, bytes]] = field(default_factory=list)

    def lines(self) -> list[tuple[str, ...]]:
        """A line of the table for each object."""
        found = []
        for name, track in self.tracks.items():
            residual = self.residuals[name][track.seen]
            shares = track.seen, track.known & ~track.seen, ~track.known
            numbers = [f"{100 * one.mean():.0f} %" for one in shares]
            first, last = longest_gap(track.seen)
            gap, millimetres = self._length(first, last), f"{1e3 * track.spread:.1f} mm"
            pixels = (f"{one:.2f} px" for one in (np.median(residual), residual.max()))
            found.append(
                (str(self.index), name, *numbers, f"{gap:.2f} s", millimetres, *pixels)
            )
        return found

    def rows_to_show(self) -> dict[int, str]:
        """The rows whose pictures say most, and what they show."""
        rows: dict[int, str] = {}
        for name, track in self.tracks.items():
            residual = np.where(track.seen, self.residuals[name], -1)
            for row in residual.argsort()[::-1][: min(WORST, track.seen.sum())].tolist():
                rows.setdefault(row, f"{name}, {residual[row]:.2f} px")
            first, last = longest_gap(track.seen)
            if last > first:
                row = (first + last) // 2
                rows.setdefault(row, f"{name} is not seen: {self.reasons[name][row]}")
        return rows

    def _length(self, first: int, last: int) -> float:
        """Of rows from the first to the one before the last [s]."""
        period = float(np.median(np.diff(self.time))) if len(self.time) > 1 else 0.0
        return (last - first) * period


def longest_gap(seen: Flags) -> tuple[int, int]:
    """The rows from which, and to which, an object was not seen for the longest time."""
    marks = np.flatnonzero(np.concatenate(([True], seen, [True])))
    at = int(np.diff(marks).argmax())
    return int(marks[at]), int(marks[at + 1]) - 1


def drawn(
    picture: Picture,
    camera: Camera,
    seen: Mapping[int, Array],
    expected: Mapping[int, Array],
) -> bytes:
    """A picture (JPEG) around corners (4, 2) of tags that were seen and that were expected."""
    points = np.concatenate([*seen.values(), *expected.values(), np.empty((0, 2))])
    left, top, width = 0, 0, camera.width
    if len(points):
        middle, extent = points.mean(axis=0), float(np.ptp(points, axis=0).max())
        width = int(min(max(AROUND * extent, LEAST_AROUND), camera.width, camera.height))
        corner = np.clip(middle - width / 2, 0, (camera.width - width, camera.height - width))
        left, top = (int(one) for one in corner)
        picture = picture[top : top + width, left : left + width]
    scale = WIDTH / width
    large = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    colours = (EXPECTED_COLOUR, expected), (SEEN_COLOUR, seen)
    for colour, corners in chain((c, one) for c, tags in colours for one in tags.values()):
        places = ((corners - (left, top) + 0.5) * scale - 0.5) * 2**BITS
        cv2.polylines(
            large, [places.round().astype(np.int32)], True, colour, 1, cv2.LINE_AA, BITS
        )
    return bytes(cv2.imencode(".jpg", large[..., ::-1])[1])


def table(reports: Sequence[EpisodeReport]) -> list[tuple[str, ...]]:
    """A line for each object in each episode, below a head."""
    return [HEAD, *(line for report in reports for line in report.lines())]


def report_page(title: str, reports: Sequence[EpisodeReport]) -> str:
    """A page (HTML) with the table, and the pictures of each episode."""
    head, *lines = table(reports)
    rows = ["".join(f"<th>{one}</th>" for one in head)]
    rows += ["".join(f"<td>{html.escape(one)}</td>" for one in line) for line in lines]
    parts = [
        f"<h1>{html.escape(title)}</h1><p>Corners: green was seen, orange is expected.</p>"
    ]
    parts.append(f"<table>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>")
    for report in reports:
        parts.append(f"<h2>Episode {report.index}</h2>")
        for caption, picture in report.pictures:
            source = f"data:image/jpeg;base64,{base64.b64encode(picture).decode()}"
            said = f"<figcaption>{html.escape(caption)}</figcaption>"
            parts.append(f'<figure><img src="{source}" alt="">{said}</figure>')
    return f"<!doctype html><meta charset=utf-8><style>{STYLE}</style>{''.join(parts)}"
