"""Mistakes that people make with recordings and situations: a table to run through.

Each is a function that does what they do, and a pattern of what they have to be told. The base
is the paper's skill: aligned demonstrations, the upper body, and one bottle.
"""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch

from tests.support import lerobot_sets as sets
from tests.support.robot_zoo import G1_PATH
from tests.support.skills import bottle_demonstrations, bottle_model, thinned
from tests.support.worlds import upper_body
from tpgmm_datasets import FramePose, LinkPose, Scale, check, load_lerobot, save_lerobot
from tpgmm_datasets.bottle.skill import bottle_operators
from tpgmm_datasets.robots import parse_robot
from tpgmm_datasets.tables import (
    demonstrations_from_frame,
    demonstrations_to_frame,
    read_table,
)
from tpgmm_torch import (
    Demonstration,
    Frame,
    RelativePosition,
    Robot,
    Situation,
    TaskParameterizedGMM,
    quaternions,
    save,
)
from tpgmm_torch.data.pose_names import POSE_PARTS
from tpgmm_torch.persistence import load_model
from tpgmm_torch.robots import Poses

__all__ = ["MISTAKES", "Mistake", "written_arms"]

DEGREES = 180 / math.pi


@dataclass(frozen=True)
class Mistake:
    """What people do, what kind of mistake it is, and what they are told."""

    group: str
    name: str
    told: str
    make: Callable[[Path], object]

    def __str__(self) -> str:
        return f"{self.group}-{self.name}"


MISTAKES: list[Mistake] = []


def enter(group: str, rows: list[tuple[str, str, Callable[[Path], object]]]) -> None:
    """Enter a name, what is told, and what makes it, for each of a group."""
    MISTAKES.extend(Mistake(group, *row) for row in rows)


def mistake(group: str, told: str) -> Callable[[Callable[[Path], object]], object]:
    """Enter a function into the table under its own name."""
    return lambda make: enter(group, [(make.__name__, told, make)])


@cache
def shown() -> tuple[Demonstration, ...]:
    """Eight aligned demonstrations, at 5 steps a second."""
    return tuple(
        replace(thinned(item, 4), joint_names=upper_body().joint_names)
        for item in bottle_demonstrations()[:8]
    )


@cache
def fine() -> tuple[Demonstration, ...]:
    """The same at 20 steps a second."""
    names = upper_body().joint_names
    return tuple(replace(item, joint_names=names) for item in bottle_demonstrations()[:8])


def learn(demonstrations, operators=None, robot=None, **options):
    robot = upper_body() if robot is None else robot
    operators = bottle_operators() if operators is None else operators
    model = TaskParameterizedGMM(2, operators, robot, tol=1e6, **options)
    return model.fit(demonstrations)


def lint(demonstrations, robot=None):
    """Check recordings before anybody learns from them."""
    check(demonstrations, upper_body() if robot is None else robot).act()


@cache
def learned() -> TaskParameterizedGMM:
    return bottle_model(4, tol=1e6).fit(shown())


def usual() -> Situation:
    """A situation like those shown."""
    return Situation(shown()[0].joints[0], shown()[1].frames)


def predict(situation):
    return learned().predict([situation], candidates=False)


def each(change, demonstrations=None):
    return [change(item) for item in demonstrations or shown()]


def one(change, index=2, demonstrations=None):
    """Change one of them."""
    items = list(demonstrations or shown())
    items[index] = change(items[index])
    return items


def joints(factor=1.0, columns=slice(None), add=0.0):
    def change(values):
        values[:, columns] = values[:, columns] * factor + add

    return edit(change)


def edit(change):
    """Change the joints of a demonstration in place of a copy of them."""

    def edited(item):
        values = item.joints.clone()
        change(values)
        return replace(item, joints=values)

    return edited


def bottles(change):
    """Change the frame of a demonstration or situation."""
    return lambda item: replace(item, frames={"bottle": change(item.frames["bottle"])})


def scale_bottle(factor):
    return bottles(lambda frame: Frame(frame.position * factor, frame.orientation))


def move_bottle(*shift):
    shift = torch.tensor(shift, dtype=torch.float64)
    return bottles(lambda frame: Frame(frame.position + shift, frame.orientation))


def as_xyzw(frame):
    return Frame(frame.position, frame.orientation.roll(-1, dims=-1))


def change_time(change):
    return lambda item: replace(item, time=change(item.time))


def drop_names(order):
    return lambda item: replace(item, joints=item.joints[:, order], joint_names=None)


def write_set(folder, **options):
    """A small LeRobot set, of which the units are not declared."""
    root = folder / "set"
    sets.write(root, **options)
    sets.undeclared(root, 1.0)
    return root


def multiply_state(root, factors):
    change = lambda values: values * factors  # noqa: E731
    sets.change_table(
        root, sets.DATA, lambda t: sets.set_column(t, "observation.state", change)
    )
    return root


# -- units ---------------------------------------------------------------------------------


enter("units", [
    ("all_joints_in_degrees", r"units: .*cannot be.*degrees",
     lambda _: learn(each(joints(DEGREES)))),
    ("one_joint_in_degrees", r"units: .*cannot be.*degrees",
     lambda _: learn(each(joints(DEGREES, 6)))),
    ("degrees_without_a_robot", r"units: .*hardly are.*degrees",
     lambda _: check(each(joints(DEGREES))).act()),
    ("joints_normalised_to_a_hundred", r"units: .*cannot be",
     lambda _: learn(each(joints(60.0)))),
    ("joints_in_ticks", r"units: .*cannot be",
     lambda _: learn(each(joints(4096 / math.tau, add=2048.0)))),
    ("bottle_in_millimetres", r"units: .*'bottle'.*millimetres",
     lambda _: learn(each(scale_bottle(1000.0)))),
    ("bottle_in_centimetres", r"units: .*'bottle'.*centimetres",
     lambda _: learn(each(scale_bottle(100.0)))),
    ("offsets_of_six_radians", r"limits: .*beyond",
     lambda _: lint(each(joints(add=4.0, columns=4)))),
    ("start_posture_in_degrees", r"units: .*start posture.*degrees",
     lambda _: predict(replace(usual(), joints=usual().joints * DEGREES))),
    ("new_bottle_in_millimetres", r"place: bottle: x = \d+\.?\d*, shown",
     lambda _: predict(scale_bottle(1000.0)(usual()))),
    ("new_bottle_in_centimetres", r"place: bottle: x = \d+\.?\d*, shown",
     lambda _: predict(scale_bottle(100.0)(usual()))),
    ("a_set_in_degrees", r"not radians: .*'left_elbow'.*'right_elbow'",
     lambda folder: load_lerobot(multiply_state(write_set(folder), 600.0))),
    ("a_misspelt_unit", r"unit 'degree' is unknown",
     lambda folder: load_lerobot(write_set(folder), units="degree")),
    ("arms_in_lerobots_units_that_nobody_said", r"not radians.*'lerobot'",
     lambda folder: load_arms(folder)),
    ("a_pattern_that_is_misspelt", r"units names \['\*griper'\], which fit no value",
     lambda folder: load_arms(folder, units={"*": "deg", "*griper": "raw"})),
])  # fmt: skip


@mistake("units", r"units: .*millimetres")
def hands_in_millimetres(_):
    poses = Poses(("hand",))
    time = np.linspace(0, 2, 40)
    items = []
    for n in range(5):
        path = np.stack((300 + 90 * np.sin(time + n), 200 * time, 100 + 0 * time), axis=1)
        turn = np.tile([1.0, 0, 0, 0], (40, 1))
        frame = {"cup": Frame([0.3, 0.1 * n, 0.1])}
        items.append(Demonstration(time, np.hstack((path, turn)), frame, poses.joint_names))
    lint(items, poses)


@mistake("units", r"(not radians|undecided).*right_elbow")
def a_set_in_degrees_of_which_one_joint_is_quiet(folder):
    root = multiply_state(write_set(folder), [100.0, 1.0, 1.0])
    load_lerobot(root, units={"left_elbow": "deg"})


@mistake("units", r"(not radians|undecided).*right_elbow")
def a_calibrated_set_of_which_one_joint_is_quiet(folder):
    root = multiply_state(write_set(folder), [100.0, 1.0, 1.0])
    load_lerobot(root, units={"left_elbow": Scale.from_calibration(1000, 3000)})


@mistake("units", r"not radians: .*'left_elbow'")
def the_quiet_episodes_of_a_set_in_degrees(folder):
    items = [sets.demonstration(n, 12) for n in range(3)]
    items[2] = replace(items[2], joints=items[2].joints * 600)
    save_lerobot(items, folder / "set", fps=50, task="reach")
    sets.undeclared(folder / "set", 1.0)
    load_lerobot(folder / "set", episodes=[0, 1])


@mistake("units", r"units: .*millimetres")
def a_set_with_its_bottle_in_millimetres(folder):
    demonstrations = [
        replace(sets.demonstration(n, 12), frames={"bottle": Frame([300.0 + 20 * n, 90, 40])})
        for n in range(4)
    ]
    save_lerobot(demonstrations, folder / "set", fps=50, task="reach")
    load_lerobot(folder / "set")


# -- time ----------------------------------------------------------------------------------


enter("time", [
    ("time_in_milliseconds", r"time: .*milliseconds",
     lambda _: learn(each(change_time(lambda time: 1000 * time)))),
    ("time_in_minutes", r"speed: .*faster than the robot",
     lambda _: lint(each(change_time(lambda time: time / 60)))),
    ("one_recording_in_milliseconds", r"(time|durations|alignment): ",
     lambda _: learn(one(change_time(lambda time: 1000 * time)))),
    ("time_that_goes_back", r"time must increase strictly",
     lambda _: one(change_time(lambda time: time.flip(0)))),
    ("a_time_twice", r"time must increase strictly",
     lambda _: one(change_time(lambda time: torch.cat((time[:5], time[4:-1]))))),
    ("a_new_situation_in_milliseconds", r"(time|place|.*)references are wanted",
     lambda _: predict(replace(usual(), time=1000 * shown()[0].time))),
    ("an_event_in_milliseconds", r"outside the demonstration",
     lambda _: replace(shown()[0], events={"grasp": 4200.0})),
])  # fmt: skip


@mistake("time", r"time: .*numbers of frames")
def frame_numbers_for_time(_):
    learn(each(change_time(lambda time: torch.arange(len(time), dtype=torch.float64))))


@mistake("time", r"time: .*another unit")
def time_in_days(_):
    lint(each(lambda item: replace(item, time=item.time / 86400, events={}), fine()))


@mistake("time", r"alignment: .*begin at different times")
def clocks_that_do_not_begin_together(_):
    learn([change_time(lambda t, n=n: t + 30.0 * n)(item) for n, item in enumerate(shown())])


@mistake("time", r"gaps: nothing was recorded for")
def a_hole_in_a_recording(_):
    def cut(item):
        keep = torch.cat((torch.arange(20), torch.arange(120, len(item))))
        return replace(item, time=item.time[keep], joints=item.joints[keep])

    lint(one(cut, demonstrations=fine()))


@mistake("time", r"time: references are wanted from 4000")
def a_tick_in_milliseconds(_):
    model = bottle_model(4, tol=1e6).fit(shown())
    model.step(4000.0, usual().joints, usual().frames)


# -- lengths -------------------------------------------------------------------------------


@mistake("lengths", r"alignment: .*last from")
def unequal_lengths_without_alignment(_):
    learn([change_time(lambda t, n=n: t * (1 + n / 20))(d) for n, d in enumerate(shown())])


enter("lengths", [
    ("a_single_demonstration", r"freedom: one demonstration", lambda _: learn(shown()[:1])),
    ("two_demonstrations", r"freedom: two demonstrations",
     lambda _: learn(shown()[:2], covariance_shrinkage=0.0)),
    ("copies_of_one_demonstration", r"copies: .*demonstration 1 is a copy of 0",
     lambda _: lint([shown()[0], *shown()])),
    ("a_recording_that_ran_on", r"durations: .*demonstration 2",
     lambda _: lint(one(change_time(lambda time: 4 * time)))),
    ("fewer_times_than_postures", r"joints has shape \(T, n_joints\) with T",
     lambda _: Demonstration(shown()[0].time[:-1], shown()[0].joints)),
    ("fewer_poses_than_postures", r"frame 'bottle' has leading shape",
     lambda _: bottles(lambda frame: frame.expand((7,)))(shown()[0])),
    ("no_demonstrations", r"at least one demonstration", lambda _: learn([])),
    ("a_demonstration_that_is_no_list", r"expected a list of demonstrations, got one",
     lambda _: learn(shown()[0])),
])  # fmt: skip


# -- order ---------------------------------------------------------------------------------


@mistake("order", r"order: the joints are unnamed.*limits")
def unnamed_joints_arms_exchanged(_):
    order = [0, 1, 2, *range(10, 17), *range(3, 10)]
    lint(each(drop_names(order)))


enter("order", [
    ("unnamed_joints_reversed", r"(order|limits): .*limits",
     lambda _: lint(each(drop_names(list(range(16, -1, -1)))))),
    ("start_posture_in_another_order", r"(order|limits|start): ",
     lambda _: predict(replace(usual(), joints=usual().joints.flip(0)))),
    ("joints_transposed", r"joints has shape|joint_names needs",
     lambda _: Demonstration(shown()[0].time, shown()[0].joints.T)),
])  # fmt: skip


@mistake("order", r"(order|limits|episodes): ")
def two_columns_exchanged_in_one_demonstration(_):
    order = list(range(17))
    order[4], order[6] = 6, 4
    lint(one(lambda d: replace(d, joints=d.joints[:, order])))


@mistake("order", r"frames: frame 'bottle'.*demonstration 2")
def x_and_z_exchanged_in_one_demonstration(_):
    flip = bottles(lambda f: Frame(f.position.flip(0) + f.position.new_tensor([0, 0, 0]), None))
    lint(one(lambda d: flip(move_bottle(0.0, 0.0, 0.0)(scale_bottle(3.0)(d)))))


@mistake("order", r"place: bottle")
def x_and_y_exchanged_in_a_situation(_):
    predict(bottles(lambda f: Frame(f.position[[1, 0, 2]], f.orientation))(usual()))


@mistake("order", r"place: (cup|plate)")
def frames_exchanged_in_a_situation(_):
    frames = {"cup": Frame([0.6, 0, 0]), "plate": Frame([0, 0, 0])}
    start = torch.tensor([0, 0, 0, 1.0, 0, 0, 0], dtype=torch.float64)
    two_frames().predict([Situation(start, frames)], candidates=False)


@mistake("order", r"frames: .*demonstration 3")
def frames_exchanged_in_one_demonstration(_):
    items = list(two_frame_demonstrations())
    frames = items[3].frames
    items[3] = replace(items[3], frames={"cup": frames["plate"], "plate": frames["cup"]})
    lint(items, Poses(("hand",)))


FROM_TWO_FRAMES = [RelativePosition("hand", "cup"), RelativePosition("hand", "plate")]


def two_frame_demonstrations():
    """A hand goes from the cup to the plate."""
    time = np.linspace(0, 2, 40)
    rng = np.random.default_rng(0)
    for _ in range(6):
        cup = rng.uniform(-0.05, 0.05, 3)
        plate = rng.uniform([0.55, -0.05, -0.05], [0.65, 0.05, 0.05])
        share = (1 - np.cos(np.pi * time / 2))[:, None] / 2
        path = np.hstack((cup + share * (plate - cup), np.tile([1.0, 0, 0, 0], (40, 1))))
        names = Poses(("hand",)).joint_names
        yield Demonstration(time, path, {"cup": Frame(cup), "plate": Frame(plate)}, names)


@cache
def two_frames():
    return learn(list(two_frame_demonstrations()), FROM_TWO_FRAMES, Poses(("hand",)))


# -- names ---------------------------------------------------------------------------------


enter("names", [
    ("an_operator_on_a_frame_that_is_not_there", r"'cup' .*\['bottle'\]",
     lambda _: learn(shown(), [RelativePosition("l_hand", "cup")])),
    ("an_operator_on_a_link_that_is_not_there", r"'left_hand' .*l_hand",
     lambda _: learn(shown(), [RelativePosition("left_hand", "bottle")])),
    ("a_situation_with_another_name", r"'bottle'.*\['flask'\]",
     lambda _: predict(replace(usual(), frames={"flask": usual().frames["bottle"]}))),
    ("another_frame_in_one_demonstration", r"demonstration 2 has frames \['cup'\]",
     lambda _: learn(one(lambda d: replace(d, frames={"cup": d.frames["bottle"]})))),
    ("a_robot_without_that_link", r"link 'hand' is not in the URDF",
     lambda _: Robot.from_urdf(G1_PATH, ["hand"])),
    ("a_set_without_names", r"does not name its 3 values.*--joint-name robot",
     lambda folder: load_lerobot(name_values(write_set(folder), None), robot=ARM)),
])  # fmt: skip


@mistake("names", r"joint .* is not in the demonstration")
def joints_of_another_robot(_):
    names = tuple(f"j{n}" for n in range(17))
    learn(each(lambda item: replace(item, joint_names=names)))


@mistake("names", r"joint_names needs 17 different names")
def a_joint_named_twice(_):
    names = upper_body().joint_names
    replace(shown()[0], joint_names=(names[0], *names[:-1]))


@mistake("names", r"event 'touch' is not in the demonstration")
def a_frame_at_an_event_that_is_not_there(folder):
    root = folder / "set"
    items = [replace(sets.demonstration(0, 12), events={})]
    save_lerobot(items, root, fps=50, task="reach")
    robot = sets.Arm("left_elbow", "right_elbow")
    load_lerobot(root, robot=robot, frames={"cup": LinkPose("hand", "touch")})


def name_values(root, names):
    sets.change_info(root, lambda i: i["features"]["observation.state"].update(names=names))
    sets.change_table(root, sets.DATA, lambda table: table)
    return root


ARM = sets.Arm("left_elbow", "right_elbow", "gripper")


@mistake("names", r"'gripper' is there twice.*--joint-name")
def a_set_that_names_two_values_alike(folder):
    load_lerobot(
        name_values(write_set(folder), ["left_elbow", "gripper", "gripper"]), robot=ARM
    )


@mistake("names", r"2 names for 3 values.*--joint-name")
def a_set_that_names_too_few_values(folder):
    load_lerobot(name_values(write_set(folder), ["left_elbow", "right_elbow"]), robot=ARM)


@mistake("names", r"0 is no name.*--joint-name")
def a_set_with_numbers_for_names(folder):
    load_lerobot(name_values(write_set(folder), {"motors": [0, 1, 2]}), robot=ARM)


@mistake("names", r"joints: 'action' is read.*measured_joints.*--joints")
def measured_joints_under_another_name(folder):
    root, name = write_set(folder), "measured_joints"
    sets.change_table(
        root,
        sets.DATA,
        lambda t: t.rename_columns(
            [name if c == "observation.state" else c for c in t.column_names]
        ),
    )
    sets.change_info(
        root, lambda i: i["features"].update({name: i["features"].pop("observation.state")})
    )
    load_lerobot(root)


# -- quaternions ---------------------------------------------------------------------------


enter("quaternions", [
    ("quaternions_with_w_last", r"quaternions: .*\(x, y, z, w\)",
     lambda _: lint(each(bottles(as_xyzw)))),
    ("quaternion_of_a_situation_with_w_last", r"turn: bottle: .*Read as \(x, y, z, w\)",
     lambda _: predict(bottles(as_xyzw)(usual()))),
    ("a_quaternion_of_zeros", r"unit quaternion", lambda _: Frame([0.3, 0, 0.1], [0, 0, 0, 0])),
    ("a_quaternion_that_is_no_unit", r"unit quaternion",
     lambda _: Frame([0.3, 0, 0.1], [0.9, 0.3, 0.3, 0.3])),
    ("euler_angles_for_a_quaternion", r"orientation\s+of shape",
     lambda _: Frame([0.3, 0, 0.1], [0.1, 0.2, 0.3])),
    ("a_matrix_for_a_quaternion", r"orientation\s+of shape",
     lambda _: Frame([0.3, 0, 0.1], np.eye(3))),
])  # fmt: skip


@mistake("quaternions", r"frames: .*turned.*demonstration 2.*\(w, x, y, z\)")
def quaternions_with_w_last_in_one_demonstration(_):
    lint(one(bottles(as_xyzw)))


@mistake("quaternions", r"turn: bottle: turned by 90 deg")
def a_bottle_lying_down(_):
    half = quaternions.exp(torch.tensor([math.pi / 2, 0, 0], dtype=torch.float64))
    predict(bottles(lambda f: Frame(f.position, half))(usual()))


@mistake("quaternions", r"norm of a quaternion is off")
def columns_of_a_pose_one_off(folder):
    root = folder / "set"
    sets.write(root)
    pose = FramePose("observation.environment_state", columns=[1, 2, 3, 4, 5, 6, 0])
    load_lerobot(root, frames={"bottle": pose})


# -- frames --------------------------------------------------------------------------------


enter("frames", [
    ("a_tracker_that_lost_the_bottle", r"frames: .*demonstration 2 \(0, 0, 0\)",
     lambda _: lint(one(scale_bottle(0.0)))),
    ("another_base_in_one_demonstration", r"frames: .*demonstration 2",
     lambda _: lint(one(move_bottle(0.0, 0.8, 0.0)))),
    ("a_bottle_that_is_nowhere", r"NaN or infinite", lambda _: Frame([0.3, math.nan, 0.1])),
])  # fmt: skip


@mistake("frames", r"frames: frame 'bottle' jumps .*demonstration 2")
def a_tracker_that_jumps(_):
    def jumping(item):
        frame = item.frames["bottle"].expand((len(item),))
        position = frame.position.clone()
        position[100:103] += 0.5
        return replace(item, frames={"bottle": Frame(position, frame.orientation)})

    lint(one(jumping, demonstrations=fine()))


@mistake("frames", r"place: bottle: z = 0\.35, shown 0\.1")
def a_bottle_far_above_those_shown(_):
    position = [*usual().frames["bottle"].position[:2].tolist(), 0.35]
    predict(bottles(lambda f: Frame(position, f.orientation))(usual()))


@mistake("frames", r"place: bottle: x = -0\.28")
def a_bottle_behind_the_robot(_):
    position = [-0.28, 0.0, 0.15]
    predict(bottles(lambda f: Frame(position, f.orientation))(usual()))


@mistake("frames", r"place: bottle: y = 1")
def a_tick_with_the_bottle_elsewhere(_):
    model = bottle_model(4, tol=1e6).fit(shown())
    model.step(1.0, usual().joints, move_bottle(0.0, 1.0, 0.0)(usual()).frames)


# -- measured poses ------------------------------------------------------------------------


def moving(start, step):
    return [f"{e},{start + step * n},0.{n},0,0" for e in range(3) for n in range(9)]


STILL, ONES = "episode,x,y,z", ["0,0.3,0.1,0.0", "1,0.3,0.2,0.0", "2,0.4,0.2,0.0"]
#: A table of a cup's poses beside a set of three episodes: name, header, rows, what is told.
MEASURED = (
    ("an_episode_without_a_pose", STILL, ONES[:2],
     r"episode 2: .* 0 rows for this .*--episodes"),
    ("two_poses_for_an_episode", STILL, [*ONES, ONES[1]],
     r"episode 1: .*2 rows for this .*'time'"),
    ("episodes_from_one", STILL, ["1,0,0,0", "2,0,0,0", "3,0,0,0"],
     r"episodes 3, the set has 0 to 2"),
    ("episodes_by_name", STILL, ["a,0,0,0", "b,0,0,0"], r"'episode' holds no numbers"),
    ("half_episodes", STILL, ["0.5,0,0,0"], r"episodes 0.5, the set has 0 to 2"),
    ("no_rows", STILL, [], r"no rows"),
    ("no_episodes", "x,y,z", ["0,0,0"], r"columns .* Name them episode"),
    ("no_height", "episode,x,y", ["0,0.3,0.1"], r"Name them episode, x, y, z"),
    ("half_a_quaternion", f"{STILL},qx,qy,qz", ["0,0,0,0,0,0,0"], r"qw, qx, qy, qz"),
    ("two_rotations", f"{STILL},yaw,yaw_deg", ["0,0,0,0,0,0"],
     r"\['yaw_deg'\] are unknown or there twice"),
    ("semicolons", "episode;x;y;z;up", ["0;0;0;0;1"], r"\['up'\] are unknown"),
    ("another_column", f"{STILL},score", ["0,0,0,0,1"], r"\['score'\] are unknown"),
    ("another_object", "episode,mug.x,mug.y,mug.z", ONES, r"'mug.z'\]. Name them .*cup.x"),
    ("millimetres", STILL, ["0,300,100,0", *ONES[1:]], r"episode 0: .*316.2 m away.*x_mm"),
    ("degrees", f"{STILL},yaw", [f"{row},90" for row in ONES], r"in degrees\? .*yaw_deg"),
    ("a_gap", STILL, ["0,0.3,,0.0", *ONES[1:]], r"episode 0: .*'y' lacks a value"),
    ("infinity", STILL, ["0,0.3,inf,0.0", *ONES[1:]], r"episode 0: .*NaN or infinite|inf m"),
    ("no_unit", f"{STILL},qx,qy,qz,qw", [f"{row},0,0,0.6,0.9" for row in ONES], r"norm .* off"),
    ("milliseconds", "episode,time,x,y,z", moving(0, 20), r"from 0 to 160,.*in seconds"),
    ("time_of_day", "episode,time,x,y,z", moving(1.7e9, 0.02), r"from the start of each"),
    ("no_time_goes_by", "episode,time,x,y,z", moving(0.1, 0), r"time does not increase"),
)  # fmt: skip


def load_measured(folder, header, rows):
    sets.write(folder / "set")
    (folder / "poses.csv").write_text("\n".join([header, *rows]))
    load_lerobot(folder / "set", frames={"cup": folder / "poses.csv"})


for name, header, rows, told in MEASURED:
    make = partial(load_measured, header=header, rows=rows)
    MISTAKES.append(Mistake("poses", name, told, make))


@mistake("poses", r"a Frame for all, or one for each of .*; got list of 3 float")
def a_position_in_place_of_a_frame(folder):
    sets.write(folder / "set")
    load_lerobot(folder / "set", frames={"cup": [0.3, 0.1, 0.0]})


@mistake("poses", r"turn: bottle: .*the pose of l_hand at grasp .*offset=")
def the_object_for_the_hand_that_held_it(_):
    def grasped(item):
        frame = upper_body().state(item.joints[len(item) // 2]).pose("l_hand")
        vars(frame).update(at="l_hand@grasp")
        return replace(item, frames={"bottle": frame})

    model = learn(each(grasped))
    pose = grasped(shown()[0]).frames["bottle"]
    model.predict([Situation(shown()[0].joints[0], {"bottle": Frame(pose.position)})])


# -- values --------------------------------------------------------------------------------


@mistake("values", r"wraps: .*whole turn.*demonstration 2")
def angles_that_wrap(_):
    def wrap(values):
        values[120:, 3] -= math.tau

    lint(one(edit(wrap), demonstrations=fine()))


@mistake("values", r"jumps: .*demonstration 2")
def a_value_that_was_lost(_):
    def spoil(values):
        values[130, 5] += 0.6

    lint(one(edit(spoil), demonstrations=fine()))


@mistake("values", r"clipped: .*stop dead")
def values_that_were_clipped(_):
    def clip(values):
        for joint in (3, 10):
            high = torch.quantile(values[:, joint], 0.85)
            values[:, joint] = values[:, joint].clamp(max=float(high))

    lint(each(edit(clip), fine()))


@mistake("values", r"stuck: .*demonstration 2")
def a_sensor_that_is_stuck(_):
    lint(one(lambda d: joints(0.0, 3, float(d.joints[0, 3]))(d), demonstrations=fine()))


@mistake("values", r"stuck: .*demonstration 2")
def a_sensor_that_freezes_half_way(_):
    def freeze(values):
        values[80:200, 3] = values[80, 3]

    lint(one(edit(freeze), demonstrations=fine()))


@mistake("values", r"episodes: .*demonstration 2")
def another_skill_among_them(_):
    lint(one(lambda d: replace(d, joints=d.joints.flip(0) + 0.9 * torch.sin(d.time)[:, None])))


@mistake("values", r"episodes: .*run backwards: demonstration 2")
def a_recording_in_reverse(_):
    lint(one(lambda d: replace(d, joints=d.joints.flip(0)), demonstrations=shown()[:4]))


enter("values", [
    ("a_joint_that_was_not_recorded", r"still: joints never move.*: l_elbow",
     lambda _: lint(each(joints(0.0, upper_body().joint_names.index("l_elbow"))))),
    ("a_posture_that_is_not_a_number", r"NaN or infinite",
     lambda _: joints(float("nan"))(shown()[0])),
])  # fmt: skip


@mistake("values", r"start: start posture: .*shown")
def a_start_far_from_those_shown(_):
    start = usual().joints.clone()
    start[4] += 1.5
    predict(replace(usual(), joints=start))


@mistake("values", r"events: .*'grasp' at 0%.*demonstration")
def events_at_the_beginning(_):
    items = [replace(d, events={"grasp": 4.0 + 0.1 * n}) for n, d in enumerate(shown())]
    lint(one(lambda d: replace(d, events={"grasp": float(d.time[0])}), demonstrations=items))


@mistake("values", r"events: .*'grasp' at .*demonstration 2, usually")
def an_event_that_is_not_like_the_others(_):
    items = [replace(d, events={"grasp": 4.0 + 0.1 * n}) for n, d in enumerate(shown())]
    lint(one(lambda d: replace(d, events={"grasp": 11.0}), demonstrations=items))


@mistake("values", r"events: .*'grasp' comes before 'lift'.*2")
def events_in_another_order(_):
    items = [replace(d, events={"grasp": 4.0, "lift": 4.5}) for d in shown()]
    lint(one(lambda d: replace(d, events={"grasp": 4.5, "lift": 4.0}), demonstrations=items))


@mistake("values", r"events: .*'grasp' missing in 2")
def an_event_that_is_missing(_):
    items = [replace(d, events={"grasp": 4.0}) for d in shown()]
    lint(one(lambda d: replace(d, events={}), demonstrations=items))


# -- shapes --------------------------------------------------------------------------------


enter("shapes", [
    ("a_flat_list_of_joints", r"joints has shape \(T, n_joints\)",
     lambda _: Demonstration([0.0, 0.1], [0.0, 1.0])),
    ("a_position_in_the_plane", r"position has shape \(\.\.\., 3\)",
     lambda _: Frame([0.3, 0.1])),
    ("a_path_for_a_start", r"a number for each joint, got shape",
     lambda _: Situation(shown()[0].joints)),
    ("a_start_without_one_joint", r"has 16 joints, the model has 17",
     lambda _: predict(replace(usual(), joints=usual().joints[:-1]))),
    ("arrays_for_demonstrations", r"expected a list of Demonstration, item 0 is ndarray",
     lambda _: learn([d.joints.numpy() for d in shown()])),
    ("one_demonstration_without_a_joint", r"demonstration 2 has 16 joints",
     lambda _: learn(one(lambda d: Demonstration(d.time, d.joints[:, :-1], d.frames)))),
    ("frames_for_situations", r"Situation objects, got Frame",
     lambda _: learned().predict([usual().frames["bottle"]])),
    ("a_file_for_a_robot", r"got 'arm\.urdf'; .*Robot\.from_urdf",
     lambda _: check(shown(), "arm.urdf")),
    ("a_file_for_the_robot_of_a_set", r"got 'arm\.urdf'; .*Robot\.from_urdf",
     lambda folder: load_lerobot(write_set(folder), robot="arm.urdf")),
])  # fmt: skip


# -- files ---------------------------------------------------------------------------------


@mistake("files", r"\['Unnamed: 0'\] count the rows")
def a_table_with_numbers_of_rows(folder):
    demonstrations_to_frame(shown()).to_csv(folder / "log.csv")
    demonstrations_from_frame(read_table(folder / "log.csv"))


def table_of(**columns):
    table = demonstrations_to_frame(shown()[:2])
    table.attrs.clear()  # as CSV does
    return table.assign(**columns)


def stamps():
    return np.concatenate([np.arange(len(d)) / 5 for d in shown()[:2]])


enter("files", [
    ("a_table_with_a_second_clock", r"\['clock'\] count the rows or tell the time",
     lambda _: demonstrations_from_frame(table_of(clock=99 + stamps()))),
    ("a_table_that_counts_in_floats", r"\['count'\] count the rows",
     lambda _: demonstrations_from_frame(table_of(count=5 * stamps()))),
    ("a_table_with_progress", r"\['progress'\] change by the same in every row",
     lambda _: demonstrations_from_frame(table_of(progress=stamps() / 7))),
    ("a_table_with_an_empty_column", r"\['note'\] of the table are empty",
     lambda _: demonstrations_from_frame(table_of(note=math.nan))),
    ("a_table_with_a_column_twice", r"columns of one name: \['l_elbow.1'\]",
     lambda _: demonstrations_from_frame(table_of(**{"l_elbow.1": stamps() ** 2}))),
    ("a_table_with_another_calendar", r"'time' holds neither numbers nor dates.*'31\.1\.26'",
     lambda _: demonstrations_from_frame(table_of(time="31.1.26"))),
    ("a_table_with_decimal_commas", r"'elbow' holds no numbers.*'0,5'.*decimal=','",
     lambda _: demonstrations_from_frame(table_of(elbow="0,5"))),
    ("a_model_that_is_not_there", r"is missing|not a saved",
     lambda folder: load_model(folder / "model")),
    ("a_robot_that_is_not_there", r"robot\.urdf",
     lambda folder: Robot.from_urdf(folder / "robot.urdf", ["hand"])),
])  # fmt: skip


@mistake("files", r"more fields than its header")
def a_table_with_a_field_too_many(folder):
    (folder / "log.csv").write_text("time,elbow\n0.0,0.1,0.2\n0.1,0.2,0.3\n")
    demonstrations_from_frame(read_table(folder / "log.csv"))


@mistake("files", r"part of the pose of 'bottle', and no columns \['bottle.qw'")
def a_table_with_positions_of_objects(_):
    table = demonstrations_to_frame(shown())
    turns = [f"bottle.{part}" for part in POSE_PARTS[3:]]
    demonstrations_from_frame(table.drop(columns=turns))


@mistake("files", r"info\.json")
def a_folder_that_is_no_set(folder):
    (folder / "set").mkdir()
    load_lerobot(folder / "set")


@mistake("files", r"file-000\.parquet")
def a_file_that_is_cut_off(folder):
    root = write_set(folder)
    path = root / sets.DATA
    path.write_bytes(path.read_bytes()[:-500])
    load_lerobot(root)


@mistake("files", r"file-000\.parquet.*(missing|absent|not there|does not exist)")
def a_file_that_is_missing(folder):
    root = write_set(folder)
    (root / sets.DATA).unlink()
    load_lerobot(root)


@mistake("files", r"NaN")
def a_column_with_holes(folder):
    root = write_set(folder)
    sets.in_data("observation.state", sets.spoil(4, 1, math.nan))(root)
    load_lerobot(root)


@mistake("files", r"increase|time")
def rows_of_one_time(folder):
    root = write_set(folder)
    sets.in_data("timestamp", sets.stuck)(root)
    load_lerobot(root)


@mistake("files", r"joints=")
def a_set_without_a_state(folder):
    root = write_set(folder)

    def rename(info):
        info["features"]["poses"] = info["features"].pop("observation.state")
        info["features"].pop("action", None)

    sets.change_info(root, rename)
    load_lerobot(root)


@mistake("files", r"changed after it was saved")
def a_model_that_was_edited(folder):
    save(learned(), folder / "model")
    path = folder / "model" / "config.json"
    config = json.loads(path.read_text())
    config["model"]["reg_covar"] = 3.0
    path.write_text(json.dumps(config))
    load_model(folder / "model")


@cache
def two_arms() -> tuple[Demonstration, ...]:
    """Two SO-101 arms that go to a cup, in LeRobot's units."""
    robot = parse_robot("bi_so101")
    share = torch.linspace(0, 1, 40, dtype=torch.float64)[:, None]
    found = []
    for n in range(5):
        goal = 0.1 * torch.arange(12) - 0.5 + 0.02 * n
        path = torch.rad2deg(share * goal)
        path[:, [5, 11]] = 90 - 80 * share - n
        cup = robot.state(goal).position("left_gripper_frame_link")
        names = [f"{name}.pos" for name in robot.joint_names]
        found.append(Demonstration(np.arange(40) / 20, path, {"cup": Frame(cup)}, names))
    return tuple(found)


def written_arms(folder, change=lambda item: item):
    """The two arms as a stored set that says nothing of units."""
    shown = [change(item) for item in two_arms()]
    raw = dict.fromkeys(shown[0].joint_names, "raw")
    root = save_lerobot(shown, folder / "arms", fps=20, task="take the cup", units=raw)
    sets.undeclared(root, 1.0)
    return root


def load_arms(folder, change=lambda item: item, **options):
    root = written_arms(folder, change)
    robot = options.pop("robot", "bi_so101")
    return load_lerobot(root, robot=parse_robot(robot), **options)


@mistake("units", r"'left_gripper.pos' goes from .* normalised to 0 \.\.\. 100.*degrees")
def grippers_beyond_their_hundred(folder):
    load_arms(folder, joints(1.6, 5), units="lerobot")


@mistake("units", r"units: .*cannot be: 'left_gripper' .*'raw'.*drop_limits.*'lerobot'")
def raw_grippers_of_a_robot_with_limits(folder):
    load_arms(folder, units={"*": "deg", "*gripper": "raw"})


enter("robots", [
    ("bases_in_centimetres", r"20 m apart: are poses in metres, or in centimetres",
     lambda _: parse_robot("left=so101@0,20,0;right=so101@0,0,0")),
    ("an_arm_that_is_nowhere", r"robot 'right=so101' is not NAME=FILE@X,Y,Z",
     lambda _: parse_robot(["left=so101@0,0.2,0", "right=so101"])),
    ("two_arms_of_one_name", r"robot 'a=so101@0,1,0' is there twice",
     lambda _: parse_robot(["a=so101@0,0,0", "a=so101@0,1,0"])),
    ("a_base_that_is_turned_by_degrees", r"robot 'a=so101@0,0,0,90' is not .*YAW \(radians\)",
     lambda _: parse_robot("a=so101@0,0,0,90")),
])  # fmt: skip


def cups_at(place):
    return lambda item: replace(item, frames={"cup": Frame(place(item.frames["cup"].position))})


@mistake("robots", r"distance: .*'cup'.*frame of 'left_base_link', one would come to 0.00 m")
def poses_seen_from_the_left_arm(folder):
    seen = cups_at(lambda at: at - torch.tensor([0, 0.2, 0]))
    load_arms(folder, seen, robot="left=so101@0,2,0;right=so101@0,-1,0", units="lerobot")


@mistake("robots", r"distance: none of the links .* nearer than 1.\d\d m to one of .*'cup'")
def an_object_that_no_hand_comes_near(folder):
    load_arms(folder, cups_at(lambda _: [2.0, 1.0, 0.0]), units="lerobot")


@mistake("robots", r"the pose of 'left' is a Frame, x y z in metres")
def a_base_of_two_numbers(_):
    arm = parse_robot("so101")
    Robot.combine({"left": [0.0, 0.2]}, left=arm, right=arm)
