"""Report on the episodes of a tracked set: a table, and a page with pictures."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from tpgmm_vision.episodes.smoothing import Track
from tpgmm_vision.episodes.video import Picture
from tpgmm_vision.poses import Array

HEAD = (
    "episode", "object", "seen", "inferred", "unknown", "longest gap", "spread", "residual",
    "worst",
)  # fmt: skip
#: Colours (RGB) of corners that were seen and that were expected, and the width of pictures.
SEEN_COLOUR, EXPECTED_COLOUR, WIDTH = (0, 200, 0), (255, 120, 0), 480
#: What is shown around the corners: so many times their extent, at least so many pixels.
AROUND, LEAST_AROUND = 2.0, 100
#: Fractional bits of OpenCV's drawing.
BITS = 4
STYLE = "body{font:15px sans-serif}td{padding:0 1em;text-align:end}figure{display:inline-block}"


@dataclass
class EpisodeReport:
    """Results of tracking in an episode.

    Parameters
    ----------
    index : int
        Of the episode.
    tracks : dict of str to Track
        By object.
    pictures : list of (str, bytes)
        What is said of pictures, and these as JPEG.
    """

    index: int
    tracks: dict[str, Track] = field(default_factory=dict)
    pictures: list[tuple[str, bytes]] = field(default_factory=list)

    def rows_to_show(self) -> dict[int, str]:
        """Choose the rows whose pictures say most, and what they show."""
        rows: dict[int, str] = {}
        for name, track in self.tracks.items():
            worst = int(np.where(track.seen, track.residuals, -1).argmax())
            rows[worst] = f"{name}, {track.residuals[worst]:.2f} px"
            first, last = _longest_gap(track)
            if last > first:
                row = (first + last) // 2
                rows[row] = f"{name} is not seen: {track.reasons[row]}"
        return rows


def _longest_gap(track: Track) -> tuple[int, int]:
    """Find between which rows an object was not seen for the longest time."""
    marks = np.flatnonzero(np.concatenate(([True], track.seen, [True])))
    at = int(np.diff(marks).argmax())
    return int(marks[at]), int(marks[at + 1]) - 1


def table(reports: Sequence[EpisodeReport]) -> list[tuple[str, ...]]:
    """Return a line for each object in each episode, below a head."""
    lines: list[tuple[str, ...]] = [HEAD]
    for report in reports:
        for name, track in report.tracks.items():
            shares = track.seen, track.known & ~track.seen, ~track.known
            first, last = _longest_gap(track)
            gap = (last - first) * np.ptp(track.time) / max(len(track.time) - 1, 1)
            residuals = track.residuals[track.seen]
            lines.append((
                str(report.index), name, *(f"{100 * share.mean():.0f} %" for share in shares),
                f"{gap:.2f} s", f"{1e3 * track.spread:.1f} mm",
                f"{np.median(residuals):.2f} px", f"{residuals.max():.2f} px",
            ))  # fmt: skip
    return lines


def drawn(picture: Picture, seen: Mapping[int, Array], expected: Mapping[int, Array]) -> bytes:
    """Draw a picture (JPEG) around corners (4, 2) of tags that were seen or expected."""
    height, width = picture.shape[:2]
    corner, side = np.zeros(2, int), width
    if points := [*seen.values(), *expected.values()]:
        stack = np.concatenate(points)
        side = int(min(max(AROUND * np.ptp(stack, axis=0).max(), LEAST_AROUND), width, height))
        most = width - side, height - side
        corner = np.clip(stack.mean(axis=0) - side / 2, 0, most).astype(int)
        picture = picture[corner[1] : corner[1] + side, corner[0] : corner[0] + side]
    large = cv2.resize(picture, None, fx=WIDTH / side, fy=WIDTH / side)
    for colour, tags in ((EXPECTED_COLOUR, expected), (SEEN_COLOUR, seen)):
        for one in tags.values():
            place = ((one - corner + 0.5) * WIDTH / side - 0.5) * 2**BITS
            outline = [place.round().astype(np.int32)]
            cv2.polylines(large, outline, True, colour, 1, cv2.LINE_AA, BITS)
    return bytes(cv2.imencode(".jpg", large[..., ::-1])[1])


def report_page(title: str, reports: Sequence[EpisodeReport]) -> str:
    """Write a page (HTML) with the table, and the pictures of each episode."""
    lines = ["".join(f"<td>{html.escape(one)}" for one in line) for line in table(reports)]
    page = f"<!doctype html><meta charset=utf-8><style>{STYLE}</style>"
    page += f"<h1>{html.escape(title)}</h1>Corners: green was seen, orange is expected."
    page += f"<table><tr>{'<tr>'.join(lines)}</table>"
    for report in reports:
        page += f"<h2>Episode {report.index}</h2>"
        for caption, picture in report.pictures:
            content = base64.b64encode(picture).decode()
            page += f'<figure><img src="data:image/jpeg;base64,{content}" alt="">'
            page += f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    return page
