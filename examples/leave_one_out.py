"""Leave one recording out: how well a skill transfers to a situation not demonstrated.

For every episode of a real recording, the others are aligned in time and learned from. The
model then gets the situation of the held-out episode (its start posture, and the pose of the
object) and is compared with what was recorded, beside two baselines: the mean of the aligned
demonstrations, and the demonstration whose situation is nearest.

    python examples/leave_one_out.py path/to/g1_bottle --set g1
    python examples/leave_one_out.py path/to/honeytea_bimanual --set honeytea
    python examples/leave_one_out.py path/to/so101_record --set so101 --likelihood

``g1``: a Unitree G1 picks up a bottle with its right hand and puts it down; two arms of seven
joints, with the URDF of the package ``example-robot-data``, and the right hand's six fingers
as coordinates without kinematics. ``honeytea``: two tracked hands, no robot; the left brings
the cup, the right pours honey into it. ``so101``: a small arm, joints alone.

``--likelihood`` asks instead how likely the held-out episodes are, with several numbers of
Gaussians and settings of ``covariance_shrinkage``.

What the numbers say, and what they do not
------------------------------------------
Neither recording has the pose of an object. The bottle's is taken from the right hand where
it closes, which the detector of events finds in the fingers, the cup's from the left hand when
the right one pours, also in the held-out episode: as a camera would give it, but free of a
camera's error. The error at the event thus tells
whether the model goes where it is sent while doing the rest of the skill, and whether it is
there when it should be; it does not tell how well a bottle was seen. Baselines get the same
situation and cannot use it, or only by choosing a demonstration.

Where the bottle is put down is not part of the situation, so that the path after the grasp is
nobody's to know; ``place known`` tells the model that too, as where the hand opens. Without it,
the covariances of 20 coordinates from 19 demonstrations find correlations that are none, and a
far bottle drags arms along after the grasp: ``--covariance diag`` is then the safer choice.
``cup unknown`` shows the opposite: two start poses alone do not tell where the hands meet.
``start`` adds the pose of the hand at the start as a frame, which needs no sensor.

K is about one Gaussian per second for the bottle and two for the faster pouring.

Nothing else of the held-out episode is used: alignment and model are fitted on the others, and
the event's instant is the median of theirs on the common clock. Only for the errors along the
path is the held-out episode aligned too, after the prediction.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import quantile_test
from torch import Tensor

from tpgmm_control import rollout
from tpgmm_datasets import LinkPose, load_lerobot
from tpgmm_torch import (
    AbsoluteOrientation,
    AbsolutePosition,
    Canonical,
    Demonstration,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Robot,
    Situation,
    Stack,
    TaskParameterizedGMM,
    quaternions,
)
from tpgmm_torch.alignment import (
    DynamicTimeWarping,
    EventAlignment,
    LinearTimeNormalization,
)
from tpgmm_torch.alignment.base import Alignment
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots import Kinematics, Poses
from tpgmm_torch.robots.kinematics import JointSpace

G1_URDF = (
    "cmeel.prefix/share/example-robot-data/robots/g1_description/urdf/g1_29dof_rev_1_0.urdf"
)
G1_HAND = "right_rubber_hand"
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
ARM += ("wrist_roll", "wrist_pitch", "wrist_yaw")
G1_ARMS = [f"{side}_{joint}_joint" for side in ("left", "right") for joint in ARM]
FINGERS = [f"kRightHand{finger}" for finger in ("Pinky", "Ring", "Middle", "Index")]
THUMB = ["kRightHandThumbBend", "kRightHandThumbRotation"]

ALIGNMENTS: Mapping[str, Callable[[Kinematics], Alignment]] = {
    # the direction of motion is alike where postures differ, as they do from table to table
    "dtw": lambda robot: DynamicTimeWarping(features=["directions"], robot=robot),
    "barycenter": lambda robot: DynamicTimeWarping(
        "barycenter", features=["directions"], robot=robot
    ),
    "linear": lambda robot: LinearTimeNormalization(robot=robot),
    "events": lambda robot: EventAlignment(robot=robot),
}

#: What ``--likelihood`` compares.
SHRINKAGES, NUMBERS = (0.0, 0.1, 1.0, "auto"), (5, 7, 10, 13)

COLUMNS = ("event [mm]", "event [deg]", "path [mm]", "path [deg]", "joints [deg]")
COLUMNS += ("before it [mm]",)


@dataclass(frozen=True)
class Recording:
    """Demonstrations, and what to learn from them and to look at."""

    demonstrations: Sequence[Demonstration]
    robot: Kinematics
    link: str  # whose pose is compared,
    event: str  # and when
    frame: str  # the object that a situation tells of
    models: Mapping[str, Sequence[Operator]]  # the first is the one that is judged
    n_components: int
    angles: Sequence[int]  # which columns are joint angles


def pose(link: str, frame: str | None = None) -> Stack:
    """Make the operator of a link's pose, seen from a frame or from the base."""
    if frame is None:
        return Stack(AbsolutePosition(link), AbsoluteOrientation(link))
    return Stack(RelativePosition(link, frame), RelativeOrientation(link, frame))


def pouring(demonstration: Demonstration) -> float:
    """Find when the right hand is turned furthest away from its start [s]."""
    names = [f"right.{part}" for part in ("qw", "qx", "qy", "qz")]
    turn = demonstration.reorder(names).joints
    return float(demonstration.time[int((turn @ turn[0]).abs().argmin())])


def load_g1(folder: Path) -> Recording:
    """Load twenty demonstrations of picking up a bottle."""
    urdf = Path(str(distribution("example-robot-data").locate_file(G1_URDF)))
    robot = Robot.from_urdf(urdf, [G1_HAND], joints=G1_ARMS, coordinates=FINGERS + THUMB)
    demonstrations = load_lerobot(
        folder,
        robot=robot,
        frames={
            "bottle": f"{G1_HAND}@close",
            "place": f"{G1_HAND}@open",
            "start": f"{G1_HAND}@start",
        },
    )
    seen = {name: pose(G1_HAND, name) for name in ("bottle", "place", "start")}
    models = {
        "TP-GMM": (seen["bottle"], Canonical()),
        "TP-GMM, place known": (seen["bottle"], seen["place"], Canonical()),
        "TP-GMM, start": (seen["bottle"], seen["start"], Canonical()),
        "TP-GMM, start, place known": (*seen.values(), Canonical()),
    }
    angles = range(len(G1_ARMS))
    return Recording(demonstrations, robot, G1_HAND, "close", "bottle", models, 13, angles)


def load_honeytea(folder: Path) -> Recording:
    """Load nine demonstrations of pouring honey into tea."""
    robot = Poses(("left", "right"))
    demonstrations = load_lerobot(
        folder,
        robot=robot,
        rate=60,  # half of what was recorded
        events={"pour": pouring},
        frames={"cup": LinkPose("left", "pour")},
    )
    hands = (pose("left"), pose("right"), pose("right", "left"))
    models = {"TP-GMM": (*hands, pose("left", "cup")), "TP-GMM, cup unknown": hands}
    return Recording(demonstrations, robot, "right", "pour", "cup", models, 8, ())


def load_so101(folder: Path) -> Recording:
    """Load four motions of a small arm."""
    demonstrations = load_lerobot(folder, units="raw")
    robot, models = JointSpace(demonstrations[0].joint_names or ()), {"joints": (Canonical(),)}
    return Recording(demonstrations, robot, "", "end", "", models, 8, ())


RECORDINGS = {"g1": load_g1, "honeytea": load_honeytea, "so101": load_so101}


def mean_joints(demonstrations: Sequence[Demonstration], robot: Kinematics) -> Tensor:
    """Average aligned demonstrations, shape (T, n_joints)."""
    joints = torch.stack([demonstration.joints for demonstration in demonstrations])
    for start in getattr(robot, "quaternion_starts", ()):
        turn = joints[..., start : start + 4]
        same = (turn * turn[0]).sum(dim=-1, keepdim=True) >= 0
        joints[..., start : start + 4] = torch.where(same, turn, -turn)
    return robot.retract(joints.mean(dim=0))


def nearest(wanted: Demonstration, others: Sequence[Demonstration], frame: str) -> int:
    """Find the demonstration with the most similar situation.

    Start posture and object count equally; each of their numbers is standardised.
    """

    def numbers(demonstration: Demonstration) -> tuple[Tensor, Tensor]:
        seen = demonstration.frame(frame)
        upper = torch.where(seen.orientation[:1] < 0, -1, 1) * seen.orientation
        return demonstration.joints[0], torch.cat((seen.position, upper))

    apart = torch.zeros(len(others), dtype=torch.float64)
    for given, known in zip(
        numbers(wanted), zip(*map(numbers, others), strict=True), strict=True
    ):
        table = torch.stack(known)
        apart += ((table - given) / table.std(dim=0)).square().mean(dim=1)
    return int(apart.argmin())


def pose_at(recording: Recording, joints: Tensor, time: Tensor, instant: float) -> Frame:
    """Compute the pose of the link in question at the step nearest to an instant."""
    state = recording.robot.state(joints[int((time - instant).abs().argmin())])
    return Frame(state.position(recording.link), state.orientation(recording.link))


def degrees_between(a: Tensor, b: Tensor) -> Tensor:
    """Compute the angle between orientations (..., 4) [deg]."""
    turn = quaternions.log(quaternions.product(a, quaternions.conjugate(b)))
    return torch.rad2deg(torch.linalg.vector_norm(turn, dim=-1))


def errors(recording: Recording, joints: Tensor, wanted: Tensor) -> list[float]:
    """Compute root mean square errors of link positions, orientations, joint angles."""
    found, truth = recording.robot.state(joints), recording.robot.state(wanted)
    squares = [
        (
            (found.position(link) - truth.position(link)).square().sum(dim=-1),
            degrees_between(found.orientation(link), truth.orientation(link)).square(),
        )
        for link in recording.robot.links
    ]
    position, turn = (torch.stack(parts).mean().sqrt() for parts in zip(*squares, strict=True))
    apart = torch.rad2deg(joints - wanted)[:, list(recording.angles)]
    bend = apart.square().mean().sqrt()  # NaN without joints
    return [1e3 * float(position), float(turn), float(bend)]


def one_fold(
    recording: Recording, held_out: int, alignment: str, parameters: Mapping[str, Any]
) -> dict[str, list[float]]:
    """Measure every method on a held-out episode, in the order of ``COLUMNS``."""
    test = recording.demonstrations[held_out]
    train = [shown for shown in recording.demonstrations if shown is not test]
    clock = ALIGNMENTS[alignment](recording.robot)
    aligned = clock.fit_transform(train)
    instants = [shown.events[recording.event] for shown in aligned]
    usual = float(np.median(instants))

    proposals: dict[str, tuple[Tensor, float]] = {}
    for name, operators in recording.models.items():
        model = TaskParameterizedGMM(recording.n_components, operators, recording.robot)
        model.set_params(random_state=0, **parameters)
        situation = Situation(test.joints[0], test.frames, clock.time_)
        skill = model.fit(aligned).skill
        [trajectory] = rollout(skill, [situation], blend=1.0)  # from where the arm stands
        proposals[name] = trajectory.joints, usual
    closest = nearest(test, train, recording.frame)
    proposals["mean"] = mean_joints(aligned, recording.robot), usual
    proposals["nearest"] = aligned[closest].joints, instants[closest]

    truth = pose_at(recording, test.joints, test.time, test.events[recording.event])
    [wanted] = clock.transform([test])
    rows = {}
    for name, (joints, instant) in proposals.items():
        found = pose_at(recording, joints, clock.time_, instant)
        before = clock.time_ <= usual
        rows[name] = [
            1e3 * float(torch.linalg.vector_norm(found.position - truth.position)),
            float(degrees_between(found.orientation, truth.orientation)),
            *errors(recording, joints, wanted.joints),
            errors(recording, joints[before], wanted.joints[before])[0],
        ]
    return rows


def leave_one_out(
    recording: Recording,
    alignment: str = "dtw",
    folds: Sequence[int] | None = None,
    **parameters: Any,
) -> dict[str, np.ndarray]:
    """Measure errors by method, (folds, columns); ``parameters`` are the model's."""
    folds = range(len(recording.demonstrations)) if folds is None else folds
    rows = [one_fold(recording, fold, alignment, parameters) for fold in folds]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def likelihoods(
    recording: Recording, alignment: str = "dtw", folds: Sequence[int] | None = None
) -> dict[str, np.ndarray]:
    """Compute mean log-likelihoods per step of held-out episodes, shape (folds, K)."""
    operators = next(iter(recording.models.values()))
    found: dict[str, list[list[float]]] = {str(setting): [] for setting in SHRINKAGES}
    for fold in range(len(recording.demonstrations)) if folds is None else folds:
        test = recording.demonstrations[fold]
        clock = ALIGNMENTS[alignment](recording.robot)
        aligned = clock.fit_transform(
            [shown for shown in recording.demonstrations if shown is not test]
        )
        wanted = clock.transform([test])
        for setting in SHRINKAGES:
            model = TaskParameterizedGMM(
                operators=operators,
                robot=recording.robot,
                covariance_shrinkage=setting,
                random_state=0,
            )
            scores = [
                model.set_params(n_components=k).fit(aligned).score(wanted) for k in NUMBERS
            ]
            found[str(setting)].append(scores)
    return {name: np.array(rows) for name, rows in found.items()}


def table(results: Mapping[str, np.ndarray]) -> str:
    """Format median and 90th percentile over the folds, one line per method."""
    lines = [f"{'median / 90th percentile':26}" + "".join(f"{c:>16}" for c in COLUMNS)]
    for name, values in results.items():
        middle, high = np.quantile(values, (0.5, 0.9), axis=0)
        cells = [
            "-" if np.isnan(m) else f"{m:.1f} / {h:.1f}"
            for m, h in zip(middle, high, strict=True)
        ]
        lines.append(f"{name:26}" + "".join(f"{cell:>16}" for cell in cells))
    return "\n".join(lines)


def intervals(results: Mapping[str, np.ndarray]) -> str:
    """Compute intervals of the median, one line per method.

    The interval ends at two of the episodes' own values and holds with 95 % or more whatever
    their distribution (the sign test turned round); six episodes are the fewest that give one.
    """
    lines = [f"{'95 % interval of the median':26}" + "".join(f"{c:>16}" for c in COLUMNS)]
    for name, values in results.items():
        bounds = [quantile_test(column).confidence_interval() for column in values.T]
        cells = [
            "-" if np.isnan([b.low, b.high]).any() else f"{b.low:.1f} to {b.high:.1f}"
            for b in bounds
        ]
        lines.append(f"{name:26}" + "".join(f"{cell:>16}" for cell in cells))
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("folder", type=Path, help="LeRobot data set")
    parser.add_argument("--set", choices=RECORDINGS, default="g1", help="which one it is")
    parser.add_argument("--components", type=int, help="K; one or two per second by default")
    parser.add_argument("--covariance", choices=("full", "diag"), default="full")
    parser.add_argument("--alignment", choices=ALIGNMENTS, default="dtw")
    parser.add_argument("--folds", type=int, help="hold out only so many, evenly spread")
    parser.add_argument("--likelihood", action="store_true", help="of K and shrinkages")
    options = parser.parse_args(arguments)
    recording = RECORDINGS[options.set](options.folder)
    parameters = {
        "n_components": options.components or recording.n_components,
        "covariance_type": options.covariance,
    }
    n_episodes = len(recording.demonstrations)
    folds = np.linspace(0, n_episodes - 1, options.folds or n_episodes).astype(int).tolist()
    print(
        f"{options.set}: {len(folds)} of {n_episodes} episodes held out, {parameters}, "
        f"alignment {options.alignment}; {recording.link} at {recording.event!r}"
    )
    if options.likelihood:
        print(f"{'covariance_shrinkage':24}" + "".join(f"{f'K = {k}':>9}" for k in NUMBERS))
        for name, values in likelihoods(recording, options.alignment, folds).items():
            print(f"{name:24}" + "".join(f"{mean:9.1f}" for mean in values.mean(axis=0)))
        return
    results = leave_one_out(recording, options.alignment, folds, **parameters)
    print(table(results), intervals(results), sep="\n\n")


if __name__ == "__main__":
    main()
