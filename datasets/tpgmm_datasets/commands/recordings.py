"""The reader that the commands of ``tpgmm`` look up: what their options say of a data set."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from tpgmm_tools.cli import plugins

if TYPE_CHECKING:
    from tpgmm_datasets.episode_batches import EpisodeBatches
    from tpgmm_datasets.signals import Signals
    from tpgmm_torch.data.demonstrations import Demonstration
    from tpgmm_torch.large_data.processes import Processes
    from tpgmm_torch.robots.kinematics import Kinematics

__all__ = [
    "Recordings",
    "parse_episodes",
    "parse_events",
    "parse_frames",
    "parse_joint_names",
    "parse_units",
]

#: ``bottle``, ``bottle=FEATURE``, ``bottle=FEATURE[7:14]`` or ``bottle=LINK@EVENT``.
FRAME = re.compile(
    r"(?P<name>[^=@\[\]]+)"
    r"(=(?P<source>[^=@\[\]]+)(@(?P<event>[^=@\[\]]+)|\[(?P<start>\d+):(?P<stop>\d+)\])?)?"
)

#: The column that says when a person took over.
INTERVENTION = "intervention"


class Recordings(plugins.Recordings):
    """A LeRobot data set as the options of a command describe it.

    Parameters
    ----------
    dataset : str
        A folder, or a name on the hub, as for ``load_lerobot``.
    robot : Kinematics or None
        Gives the order of the joints.
    frames, events, episodes, units
        What :func:`parse_frames` and the others of these names take, or None.
    joints
        As for :func:`tpgmm_datasets.load_lerobot`.
    joint_names
        What :func:`parse_joint_names` takes, or None.
    rate, plausibility
        As for :func:`tpgmm_datasets.load_lerobot`.

    Raises
    ------
    DataError
        If a text cannot be understood.
    """

    def __init__(
        self,
        dataset: str,
        robot: Kinematics | None,
        frames: Sequence[str] | None = None,
        events: Sequence[str] | None = None,
        episodes: str | None = None,
        units: Sequence[str] | None = None,
        joints: str | None = None,
        joint_names: Sequence[str] | None = None,
        rate: float | None = None,
        plausibility: str = "warn",
    ) -> None:
        self.dataset = dataset
        self.options: dict[str, Any] = {
            "robot": robot,
            "frames": parse_frames(frames or ()),
            "events": parse_events(events or ()),
            "episodes": parse_episodes(episodes),
            **parse_units(units or ()),
            "joints": joints,
            "joint_names": parse_joint_names(joint_names or ()),
            "rate": rate,
            "plausibility": plausibility,
        }

    def demonstrations(self) -> list[Demonstration]:
        """All episodes that are meant."""
        from tpgmm_datasets.reader import load_lerobot

        return load_lerobot(self.dataset, **self.options)

    def batches(self, size: int, processes: Processes | None = None) -> EpisodeBatches:
        """The same in batches of ``size`` episodes; a share of them for each process."""
        from tpgmm_datasets.episode_batches import EpisodeBatches
        from tpgmm_torch.large_data.processes import ALONE

        return EpisodeBatches(self.dataset, size, processes=processes or ALONE, **self.options)

    def corrections(self) -> list[Demonstration]:
        """What a person did: where the set has ``intervention``, only that; else all."""
        import numpy as np

        from tpgmm_datasets.lerobot.episodes import Relaxed, read_episodes
        from tpgmm_datasets.reader import open_recording
        from tpgmm_torch.exceptions import DataError

        shown = self.demonstrations()
        recording = open_recording(self.dataset, **self.options)
        layout = recording.assembly.layout
        if INTERVENTION not in layout.features:
            return shown
        flags = [layout.features[INTERVENTION]]
        rows = read_episodes(layout, recording.episodes, flags, Relaxed(()))
        segments = []
        for demonstration, row in zip(shown, rows, strict=True):
            flag = row.values[INTERVENTION][:, 0].astype(bool)
            edges = np.flatnonzero(np.diff(np.concatenate(([False], flag, [False]))))
            for first, last in edges.reshape(-1, 2):
                segment = _between(demonstration, row.time[first], row.time[last - 1])
                segments += [segment] if segment is not None else []
        if not segments:
            raise DataError(
                f"{self.dataset} has no row with {INTERVENTION!r}: nobody took over"
            )
        return segments

    def signals(self) -> Signals:
        """What a policy that was learned from it must know."""
        from tpgmm_datasets.signals import Signals

        return Signals.of(self.dataset, **self.options)


def _between(demonstration: Demonstration, begin: float, end: float) -> Demonstration | None:
    """A segment of a demonstration; None where that has no motion."""
    inside = (demonstration.time >= begin) & (demonstration.time <= end)
    return demonstration.at_steps(inside) if int(inside.sum()) > 1 else None


def parse_frames(texts: Sequence[str]) -> dict[str, Any] | None:
    """What ``load_lerobot`` takes as ``frames``; None if nothing was given.

    Each text is ``NAME``, ``NAME=FEATURE``, ``NAME=FEATURE[7:14]`` or ``NAME=LINK@EVENT``; a
    DataError says so of any other.
    """
    from tpgmm_datasets.conversion.poses import FramePose, LinkPose
    from tpgmm_datasets.lerobot.columns import ENVIRONMENT
    from tpgmm_torch.exceptions import DataError

    frames: dict[str, Any] = {}
    for text in texts:
        match = FRAME.fullmatch(text)
        if match is None:
            raise DataError(
                f"frame {text!r} is none of NAME, NAME=FEATURE, NAME=FEATURE[7:14], "
                "NAME=LINK@EVENT"
            )
        source, event, start = match["source"], match["event"], match["start"]
        if event:
            frames[match["name"]] = LinkPose(source, event)
        elif source is None:
            frames[match["name"]] = FramePose(ENVIRONMENT, constant=None)
        else:
            columns = slice(int(start), int(match["stop"])) if start else None
            frames[match["name"]] = FramePose(source, columns)
    return frames or None


def parse_events(texts: Sequence[str]) -> dict[str, Any] | None:
    """What ``load_lerobot`` takes as ``events``; None if nothing was given.

    Each text is ``NAME=HOW``, and how is what ``parse_event`` takes; a DataError says so of
    any other.
    """
    from tpgmm_torch.events.text import parse_event

    pairs = _pairs(texts, "event", "NAME=HOW", "close=closing:*gripper*")
    return {name: parse_event(how) for name, how in pairs.items()} or None


def parse_joint_names(texts: Sequence[str]) -> dict[str, str] | None:
    """What ``load_lerobot`` takes as ``joint_names``; None if nothing was given.

    Each text is ``STORED=JOINT``; a DataError says so of any other.
    """
    return _pairs(texts, "joint name", "STORED=JOINT", "main_elbow=elbow_flex") or None


def _pairs(texts: Sequence[str], kind: str, form: str, example: str) -> dict[str, str]:
    from tpgmm_torch.exceptions import DataError

    pairs: dict[str, str] = {}
    for text in texts:
        name, _, value = (part.strip() for part in text.partition("="))
        if not name or not value or name in pairs:
            problem = "is given twice" if name in pairs else f"is not {form}"
            raise DataError(f"{kind} {text!r} {problem}, as in {example}")
        pairs[name] = value
    return pairs


def parse_episodes(text: str | None) -> slice | list[int] | str | None:
    """``"0:10"`` as a slice, ``"0,3,5"`` as a list, anything else as the name of a task."""
    if text is None:
        return None
    if re.fullmatch(r"(-?\d*):(-?\d*)", text):
        start, stop = (int(part) if part else None for part in text.split(":"))
        return slice(start, stop)
    if re.fullmatch(r"\d+(,\d+)*", text):
        return [int(part) for part in text.split(",")]
    return text


def parse_units(texts: Sequence[str]) -> dict[str, Any]:
    """What ``load_lerobot`` takes as ``units`` and ``calibration``.

    The texts are one unit for all, or any number of ``JOINT=UNIT``; and ``FILE.json`` or
    ``PREFIX=FILE.json`` for LeRobot's calibration. A DataError says so of any other.
    """
    from tpgmm_torch.exceptions import DataError

    pairs = [(name, unit) for name, _, unit in (text.rpartition("=") for text in texts)]
    calibration = {name: unit for name, unit in pairs if unit.endswith(".json")}
    named = {name: unit for name, unit in pairs if not unit.endswith(".json")}
    wrong = [text for text in texts if text.startswith("=") or text.endswith("=")]
    if wrong or len(calibration) + len(named) < len(pairs):
        raise DataError(f"units are one for all, or JOINT=UNIT for some; got {list(texts)}")
    units: Any = named or "auto"
    if "" in named:
        units = named[""]
        if len(named) > 1:
            raise DataError(f"units are one for all, or JOINT=UNIT for some; got {list(texts)}")
    return {"units": units, "calibration": calibration or None}
