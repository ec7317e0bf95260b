"""Track the objects of a recorded LeRobot data set in its own pictures, and write a copy."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tpgmm_datasets.conversion.joints import Names, joint_feature, names_of
from tpgmm_datasets.errors import DatasetError, summed_up
from tpgmm_datasets.lerobot.columns import ENVIRONMENT, with_frames
from tpgmm_datasets.lerobot.episodes import EpisodeRows, Relaxed, read_episodes
from tpgmm_datasets.lerobot.layout import Layout
from tpgmm_datasets.names import match_names
from tpgmm_datasets.reader import open_recording
from tpgmm_datasets.units import Units
from tpgmm_datasets.writer import Column, add_frames
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_vision.cell import Cell
from tpgmm_vision.episodes.report import EpisodeReport, report_page
from tpgmm_vision.episodes.smoothing import Track, smoothed
from tpgmm_vision.episodes.video import EpisodePictures
from tpgmm_vision.poses import Array, pose_matrix, pose_vector
from tpgmm_vision.sources import PoseSource, pose_source

__all__ = ["track_lerobot"]

#: Columns of a tracked set; their names do not begin with "observation.", so that no policy
#: takes them for something that it is given.
SEEN, KNOWN, RESIDUAL = "tracking.seen", "tracking.known", "tracking.residual"
CELL = "meta/cell.json"
