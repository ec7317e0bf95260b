"""What matplotlib's PDF files draw, read from the files themselves: areas, lines and words."""

import re
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

MM = 25.4 / 72
OPERATOR = re.compile(r"\(\s?((?:\\.|[^\\)])*)\)|(\[[^\]]*\]) \d+ d\b|([-+.\d]+)|([A-Za-z*]+)")


@dataclass
class Page:
    """A page; lengths and points are in mm, from its lower left corner."""

    width: float
    height: float
    areas: list[np.ndarray] = field(default_factory=list)
    """For each black area the rectangles (n, 4, 2) of its one path."""
    lines: list[tuple[np.ndarray, bool]] = field(default_factory=list)
    """Points (n, 2), and whether they are dashed."""
    words: list[tuple[float, float, str]] = field(default_factory=list)

    def pixels(self, points: np.ndarray, dpi: float) -> np.ndarray:
        """Pixels (n, 2) of points, the middle of the first pixel at (0, 0)."""
        return (np.array([0, self.height]) + np.asarray(points) * (1, -1)) / 25.4 * dpi - 0.5

    def picture(self, dpi: float = 300) -> np.ndarray:
        """The page as grey values: each pixel as dark as the share of it that is black."""
        shape = tuple(int(np.ceil(one / 25.4 * dpi)) for one in (self.height, self.width))
        black = np.zeros(shape)
        for area in self.areas:
            for rectangle in self.pixels(area.reshape(-1, 2), dpi).reshape(-1, 4, 2) + 0.5:
                (left, top), (right, bottom) = rectangle.min(0), rectangle.max(0)
                shares = [
                    np.clip(
                        np.minimum(last, np.arange(n) + 1) - np.maximum(first, np.arange(n)),
                        0,
                        1,
                    )
                    for first, last, n in ((top, bottom, shape[0]), (left, right, shape[1]))
                ]
                rows, columns = (np.flatnonzero(one) for one in shares)
                black[np.ix_(rows, columns)] += np.outer(shares[0][rows], shares[1][columns])
        assert black.max() < 1.01  # nothing is drawn over another
        grey = np.rint(255 * (1 - np.minimum(black, 1))).astype(np.uint8)
        for points, _ in self.lines:
            cv2.polylines(grey, [np.rint(self.pixels(points, dpi)).astype(int)], False, 128, 2)
        for x, y, text in self.words:
            place = np.rint(self.pixels([[x, y]], dpi)[0]).astype(int).tolist()
            cv2.putText(grey, text, place, cv2.FONT_HERSHEY_SIMPLEX, dpi / 400, 128, 2)
        return grey


def pdf_pages(path: Path) -> list[Page]:
    """The pages of a file that :class:`matplotlib.backends.backend_pdf.PdfPages` wrote."""
    content = path.read_bytes()
    objects = {
        int(number): body
        for number, body in re.findall(rb"(\d+) 0 obj\n(.*?)\nendobj", content, re.DOTALL)
    }
    found = []
    for body in objects.values():
        box = re.search(rb"/MediaBox \[ 0 0 (\S+) (\S+) \]\s/Contents (\d+) 0 R", body)
        if box is None:
            continue
        stream = objects[int(box[3])].partition(b"stream\n")[2].removesuffix(b"\nendstream")
        page = Page(float(box[1]) * MM, float(box[2]) * MM)
        _draw(page, zlib.decompress(stream).decode("latin-1"))
        found.append(page)
    return found


def _draw(page: Page, stream: str) -> None:
    """Follow the operators of a page."""
    numbers: list[float] = []
    rings: list[list[tuple[float, float]]] = []
    kept: list[tuple[float, bool]] = []
    colour, dashed, moved, text = 0.0, False, (0.0, 0.0), ""
    for one in OPERATOR.finditer(stream):
        if one[1] is not None:
            text += re.sub(r"\\(.)", r"\1", one[1].replace("\0", ""))
        elif one[2] is not None:
            dashed = one[2].strip("[] ") != ""
        elif one[3] is not None:
            numbers.append(float(one[3]))
        else:
            match one[4]:
                case "m":
                    rings.append([(numbers[-2], numbers[-1])])
                case "l":
                    rings[-1].append((numbers[-2], numbers[-1]))
                case "f" if colour < 0.5:
                    page.areas.append(np.array(rings) * MM)
                    assert page.areas[-1].shape[1:] == (4, 2)
                case "S":
                    page.lines += [(np.array(ring) * MM, dashed) for ring in rings]
                case "q":
                    kept.append((colour, dashed))
                case "Q":
                    colour, dashed = kept.pop()
                case "g":
                    colour = numbers[-1]
                case "cm":
                    moved = (numbers[-2] * MM, numbers[-1] * MM)
                case "BT":
                    text = ""
                case "ET":
                    page.words.append((*moved, text))
            if one[4] in ("f", "S", "n"):
                rings = []
            numbers = []
