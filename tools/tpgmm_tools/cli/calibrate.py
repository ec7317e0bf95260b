"""``tpgmm calibrate``: cameras by a board, cells by the robot's own motion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import typer
from rich.progress import Progress

from tpgmm_tools.arguments import options
from tpgmm_torch.exceptions import DataError, UnknownNameError

__all__ = ["app"]

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
    typer.echo(
        "\n".join([f"{name}: {result}", *(f"unlikely: {one}" for one in result.problems)])
    )
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
    from tpgmm_vision.calibration.cell_calibration import Mount, calibrate_cell
    from tpgmm_vision.calibration.recorded import slow_postures
    from tpgmm_vision.cell import pose_content, read_cell, write_cell
    from tpgmm_vision.detection.tags import Detections, TagDetector
    from tpgmm_vision.episodes.report import drawn
    from tpgmm_vision.targets import target_from

    before = read_cell(cell)
    known, content = before.cameras, dict(before.content)
    if unknown := [name for name in camera or () if name not in known]:
        raise UnknownNameError("camera", unknown[0], "the cell", known)
    cameras = {name: known[name] for name in camera or known}
    given = [[_target(one) for one in several or ()] for several in (hand, check)]
    hands, checks = map(dict, given)
    names = [name for several in given for name, _ in several]
    if len({*names}) < len(names):
        raise DataError(f"--hand and --check name each target once, got {names}")
    mounts = {
        name: Mount(target_from(entry, name), name if name in hands else None)
        for name, entry in {**checks, **hands}.items()
    }
    carriers = {one.link for one in cameras.values() if one.link}
    wanted = carriers.union(hands, described.link or ())
    robot = replace(described, link=sorted(wanted)).read()
    if robot is None or not cameras or not mounts:
        raise DataError("a cell is calibrated by its robot (--robot FILE), with cameras in it "
                        "(tpgmm calibrate camera) and tags in its hand (--hand)")  # fmt: skip
    if content.get("joints", names := list(robot.joint_names)) != names:
        raise DataError(f"{cell} is of a robot with joints {content['joints']}, this one has "
                        f"{names}: give another --cell")  # fmt: skip
    reading = options.DataOptions(units=units, joint_name=joint_name, episodes=episodes)
    recording = reading.opened(path, robot, frames={})
    joints, pictures = slow_postures(recording, {n: one.key for n, one in cameras.items()})
    find, shown = TagDetector(), list[tuple[str, int, Any]]()
    seen: dict[str, list[Detections]] = {name: [] for name in cameras}
    with Progress(transient=True) as bar:
        for k, images in enumerate(bar.track(pictures, len(joints), description="looking")):
            for name, image in images.items():
                cameras[name].camera.check(image, name)
                shown.append((name, k, image))
                seen[name].append(find(image))
    result = calibrate_cell(robot, joints, seen, cameras, mounts, bases=base or ())
    for name, pose in result.cameras.items():
        report = str(result).splitlines()[0]
        content["cameras"][name] |= {"pose": pose_content(pose), "report": report}
    for name, entry in checks.items():
        placed = {"target": entry, "pose": pose_content(result.mounts[name])}
        content.setdefault("checks", {})[name] = placed
    offsets = result.joint_offsets.items()
    content["joints"] = names
    content["joint_offsets"] = {n: round(v, 6) for n, v in offsets if n not in result.unknown}
    out.mkdir(parents=True, exist_ok=True)
    for name, k, image in shown:
        jpeg = drawn(image, seen[name][k].corners, result.expected.get((name, k), {}))
        (out / f"{name}_{k:03}.jpg").write_bytes(jpeg)
    write_cell(content, cell)
    lines = [f"{', '.join(cameras)}: {len(joints)} postures; {result}"]
    lines += [f"base of {prefix!r}: moved by {pose_content(pose)} from where --robot has it"
              for prefix, pose in result.bases.items()]  # fmt: skip
    lines += [f"unlikely: {problem}" for problem in result.problems]
    next_ = f"pictures in {out}; next: tpgmm dataset track SET OUT --cell {cell}"
    typer.echo("\n".join([*lines, f"written to {cell}, {next_}"]))


def _target(text: str) -> tuple[str, dict[str, Any]]:
    """The name of a target that an option describes, and what a cell file says of it."""
    name, _, described = text.partition("=")
    try:
        kind, numbers, size = described.split(":")
        several = [int(number) for number in numbers.split(",")]
        return name, {kind: {"cube": several, "tag": several[0]}[kind], "size": float(size)}
    except (ValueError, KeyError) as error:
        raise DataError(
            f"tags are described as NAME=cube:10,11,12,13,14:0.03 or NAME=tag:3:0.04 (numbers, "
            f"and the edge in metres), got {text!r}"
        ) from error
