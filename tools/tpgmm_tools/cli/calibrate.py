"""``tpgmm calibrate``: cameras by a board, cells by the robot's own motion."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tpgmm_tools.arguments import options

if TYPE_CHECKING:
    from tpgmm_datasets.reader import Recording
    from tpgmm_vision.calibration.cell_calibration import CellCalibration, Mount
    from tpgmm_vision.cell import CellCamera


app = typer.Typer(help="Calibrate cameras and cells.", add_completion=False)


@options.command(app, "tpgmm calibrate camera board/ --name front --cell cell.json")
def camera(
    pictures: Path,
    *,
    name: str,
    cell: Path,
    key: str | None = None,
    link: str | None = None,
    columns: int = 8,
    rows: int = 5,
    family: str = "aruco_5x5",
) -> None:
    """Find a camera's focal length and distortion by pictures of a ChArUco board.

    Take 20: the board flat, near every edge of the picture, tilted by 30 degrees to all sides.
    'tpgmm camera print --board' prints one.

    Parameters
    ----------
    pictures : ``DIR | VIDEO``
        A folder of pictures or a video, such as one of a LeRobot data set.
    name : str
        Of the camera.
    cell : ``CELL.json``
        Where the result goes; other entries stay as they are.
    key : ``FEATURE``
        Of its pictures in data sets; default observation.images.NAME.
    link : str
        The robot's link that carries it, where it does not stand still.
    columns, rows : int
        Squares of the board.
    family : ``NAME``
        Of the tags in it.
    """
    from tpgmm_vision.calibration.intrinsics import calibrate_camera
    from tpgmm_vision.calibration.recorded import board_pictures
    from tpgmm_vision.cell import camera_content, read_cell, write_cell
    from tpgmm_vision.targets import Board

    key = key or f"observation.images.{name}"
    content: dict[str, Any] = dict(read_cell(cell).content) if cell.exists() else {}
    result = calibrate_camera(board_pictures(pictures), Board(columns, rows, family=family))
    entry = camera_content(result.camera, key) | ({"link": link} if link else {})
    content.setdefault("cameras", {})[name] = entry | {"report": str(result)}
    write_cell(content, cell)
    for line in (f"{name}: {result}", *(f"unlikely: {one}" for one in result.problems)):
        typer.echo(line)
    typer.echo(f"written to {cell}; next: tpgmm calibrate cell SET --cell {cell} --robot ...")


@options.command(
    app,
    "tpgmm calibrate cell waving --robot so101 --units lerobot --cell cell.json "
    "--hand gripper_frame_link=cube:10,11,12,13,14:0.03",
)
def cell(
    path: str,
    *,
    cell: Path,
    described: options.RobotOptions,
    hand: list[str] | None = None,
    check: list[str] | None = None,
    camera: list[str] | None = None,
    base: list[str] | None = None,
    units: list[str] | None = None,
    joint_name: list[str] | None = None,
    episodes: str | None = None,
    out: Path = Path("calibration"),
) -> None:
    """Find where cameras are, and offsets of joints, by tags in the robot's own hand.

    Record one episode in which the hand turns the tags before the cameras, stopping at 30
    postures in which all joints differ by 45 degrees and more.

    Parameters
    ----------
    path : str
        A LeRobot data set with the cameras' pictures.
    cell : ``CELL.json``
        Has the cameras, as 'tpgmm calibrate camera' writes them; other entries stay.
    hand : ``LINK=TARGET``
        Tags in a hand, repeatable: LINK=cube:10,11,12,13,14:0.03 has the numbers and the edge
        of the black squares [m], LINK=tag:3:0.04 a single one.
    check : ``NAME=TARGET``
        Tags that stand still, repeatable, by which a camera that was moved is noticed.
    camera : ``NAME``
        Of the cell, repeatable; default all.
    base : ``PREFIX``
        The beginning of the names of an arm whose base is not known, repeatable.
    units : ``[JOINT=]UNIT``
        Unit of the stored joints, as of 'tpgmm fit', repeatable.
    joint_name : ``STORED=JOINT``
        The robot's name of a stored joint, as of 'tpgmm fit', repeatable.
    episodes : ``0:10 | 0,3,5``
        Which; default all.
    out : ``DIR``
        Where pictures with the corners that were seen and expected go.
    """
    from tpgmm_vision.calibration.cell_calibration import calibrate_cell
    from tpgmm_vision.cell import read_cell, write_cell

    before = read_cell(cell)
    cameras = _choose_cameras(before.cameras, camera)
    mounts, checks = _read_mounts(hand, check)
    carriers = [one.link for one in cameras.values()] + [one.link for one in mounts.values()]
    links = {*filter(None, carriers), *(described.link or ())}
    robot = replace(described, link=sorted(links)).read()
    if robot is None or not cameras or not mounts:
        raise options.refuse(
            "a cell is calibrated by its robot (--robot FILE), with cameras in it "
            "(tpgmm calibrate camera) and tags in its hand (--hand)"
        )
    content, names = dict(before.content), list(robot.joint_names)
    if content.get("joints", names) != names:
        raise options.refuse(
            f"{cell} is of a robot with joints {content['joints']}, this one has {names}: give "
            "another --cell"
        )
    reading = options.DataOptions(units=units, joint_name=joint_name, episodes=episodes)
    looked = _Pictures(reading.open(path, robot, frames={}), cameras)
    result = calibrate_cell(
        robot, looked.joints, looked.seen, cameras, mounts, bases=base or ()
    )
    _enter_result(content, result, checks, names)
    looked.write(out, result)
    write_cell(content, cell)
    for line in _report_result(result, ", ".join(cameras), len(looked.joints)):
        typer.echo(line)
    next_ = f"pictures in {out}; next: tpgmm dataset track SET OUT --cell {cell}"
    typer.echo(f"written to {cell}, {next_}")


class _Pictures:
    """Pictures of a hand that stands still, and the tags that are seen in them."""

    def __init__(self, recording: Recording, cameras: Mapping[str, CellCamera]) -> None:
        from tpgmm_vision.calibration.recorded import slow_postures
        from tpgmm_vision.detection.tags import TagDetector

        keys = {name: one.key for name, one in cameras.items()}
        self.joints, pictures = slow_postures(recording, keys)
        self.images: list[tuple[str, int, Any]] = []
        self.seen: dict[str, list[Any]] = {name: [] for name in cameras}
        find = TagDetector()
        with options.show_progress("looking") as progress:
            for k, images in enumerate(pictures):
                for name, image in images.items():
                    cameras[name].camera.check(image, name)
                    self.images.append((name, k, image))
                    self.seen[name].append(find(image))
                progress(k + 1, len(self.joints))

    def write(self, folder: Path, result: CellCalibration) -> None:
        """Write the pictures, with the corners that were seen and that were expected."""
        from tpgmm_vision.episodes.report import drawn

        folder.mkdir(parents=True, exist_ok=True)
        for name, k, image in self.images:
            corners, expected = self.seen[name][k].corners, result.expected.get((name, k), {})
            (folder / f"{name}_{k:03}.jpg").write_bytes(drawn(image, corners, expected))


def _choose_cameras(
    known: Mapping[str, CellCamera], chosen: Sequence[str] | None
) -> dict[str, CellCamera]:
    from tpgmm_torch.exceptions import UnknownNameError

    if unknown := [name for name in chosen or () if name not in known]:
        raise UnknownNameError("camera", unknown[0], "the cell", known)
    return {name: known[name] for name in chosen or known}


def _read_mounts(
    hand: Sequence[str] | None, check: Sequence[str] | None
) -> tuple[dict[str, Mount], dict[str, Any]]:
    """Return the targets of --check and --hand, and the cell file's entries of the former."""
    from tpgmm_vision.calibration.cell_calibration import Mount
    from tpgmm_vision.targets import target_from

    checks, hands = (dict(map(_target, texts or ())) for texts in (check, hand))
    names = [text.partition("=")[0] for text in (*(hand or ()), *(check or ()))]
    if len({*names}) < len(names):
        raise options.refuse(f"--hand and --check name each target once, got {names}")
    mounts = {name: Mount(target_from(entry, name), None) for name, entry in checks.items()}
    for link, entry in hands.items():
        mounts[link] = Mount(target_from(entry, link), link)
    return mounts, checks


def _enter_result(
    content: dict[str, Any],
    result: CellCalibration,
    checks: dict[str, Any],
    joints: Sequence[str],
) -> None:
    """Enter what was found into the content of a cell file."""
    from tpgmm_vision.cell import pose_content

    for name, pose in result.cameras.items():
        report = str(result).splitlines()[0]
        content["cameras"][name] |= {"pose": pose_content(pose), "report": report}
    for name, entry in checks.items():
        placed = {"target": entry, "pose": pose_content(result.mounts[name])}
        content.setdefault("checks", {})[name] = placed
    offsets = result.joint_offsets.items()
    content["joints"] = joints
    content["joint_offsets"] = {n: round(v, 6) for n, v in offsets if n not in result.unknown}


def _report_result(result: CellCalibration, cameras: str, postures: int) -> Iterator[str]:
    from tpgmm_vision.cell import pose_content

    yield f"{cameras}: {postures} postures; {result}"
    for prefix, pose in result.bases.items():
        yield f"base of {prefix!r}: moved by {pose_content(pose)} from where --robot has it"
    yield from (f"unlikely: {problem}" for problem in result.problems)


def _target(text: str) -> tuple[str, dict[str, Any]]:
    """Return the name of a target that an option describes, and its entry in a cell file."""
    name, _, described = text.partition("=")
    try:
        kind, numbers, size = described.split(":")
        several = [int(number) for number in numbers.split(",")]
        return name, {kind: {"cube": several, "tag": several[0]}[kind], "size": float(size)}
    except (ValueError, KeyError) as error:
        raise options.refuse(
            f"tags are described as NAME=cube:10,11,12,13,14:0.03 or NAME=tag:3:0.04 (numbers, "
            f"and the edge in metres), got {text!r}"
        ) from error
