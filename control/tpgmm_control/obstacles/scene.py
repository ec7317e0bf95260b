"""A robot among obstacles: which solids there are, and which pairs of them may touch."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np
import torch

from tpgmm_control.obstacles.distances import Geometry
from tpgmm_control.obstacles.shapes import Shape, excluded, solids, urdf_solids
from tpgmm_torch import quaternions
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, UnknownNameError
from tpgmm_torch.robots.held_objects import held_objects
from tpgmm_torch.robots.kinematics import Kinematics, RobotState
from tpgmm_torch.robots.mjcf import compile_mjcf
from tpgmm_torch.robots.robot import Robot
from tpgmm_torch.robots.urdf import description_text, is_text, parse_xml

__all__ = ["Scene"]

#: Names of two links, objects or obstacles, in alphabetical order.
Pair = tuple[str, str]

#: Distance that is kept, 1 cm: a grasp needs no less, and errors of geometry are smaller [m].
CLEARANCE = 0.01
#: Postures of which all have to show two links of a robot overlap for that to be how coarse its
#: solids are.
POSTURES = 50


class Scene:
    """A robot, obstacles and objects, and the distances that they keep.

    Solids of one rigid part of the robot, or of two that one joint connects, never count as a
    pair; neither do two things of which none moves. What always overlaps, as solids of links
    are coarse, is allowed, and named in ``allowed``.

    Parameters
    ----------
    robot : Robot
        Whose links carry solids: ``<collision>`` of its URDF.
    obstacles : path, str or sequence of Shape
        An MJCF (a file, or its text) or solids. Bodies of an MJCF that have a link's name are
        the robot; free and mocap bodies are objects, which move with the frame of their name;
        all others stand still in the frame of the robot's base. ``<exclude>`` allows pairs.
    geometry : path or str, optional
        A URDF or MJCF with the solids of the links, where the robot's own description has
        none.
    meshes : path, optional
        Folder of the mesh files of a URDF.
    visuals : bool, default=False
        Whether visual geometry counts where a link has no other.
    allowed : iterable of two str
        Pairs that may touch.
    clearance : float, default=0.01
        Distance that all other pairs keep [m].

    Attributes
    ----------
    allowed : mapping of (str, str) to str
        Pairs that do not count, in alphabetical order, and why.
    closer : mapping of (str, str) to float
        Pairs that may come half as near as demonstrations bring them, which is this [m].
    pairs : tuple of (str, str)
        Names of the pairs of solids that count, (P,).
    needed : ndarray of shape (P,)
        Distances that they keep [m].

    Raises
    ------
    DataError, UnknownNameError
        If there is no geometry, or a pair names what does not exist.
    DependencyError
        Without MuJoCo 3.12 or newer, of the extra ``simulation``; distances of older ones are
        wrong.

    Examples
    --------
    >>> urdf = '''<robot name="lift"><link name="base"/><link name="hand"><collision>
    ... <geometry><sphere radius="0.1"/></geometry></collision></link>
    ... <joint name="lift" type="prismatic"><parent link="base"/><child link="hand"/>
    ... <axis xyz="0 0 1"/><limit lower="0" upper="1" velocity="1" effort="1"/></joint>
    ... </robot>'''
    >>> robot = Robot.from_urdf(urdf, links=["hand"])
    >>> scene = Scene(robot, [Shape.table(0.5, centre=(0.0, 0.0))])
    >>> scene.distances([[0.8]])
    {('hand', 'table'): array([0.2])}
    """

    def __init__(
        self,
        robot: Kinematics,
        obstacles: str | os.PathLike[str] | Sequence[Shape] = (),
        *,
        geometry: str | os.PathLike[str] | None = None,
        meshes: str | os.PathLike[str] | None = None,
        visuals: bool = False,
        allowed: Iterable[Sequence[str]] = (),
        clearance: float = CLEARANCE,
    ) -> None:
        if not isinstance(robot, Robot):
            raise DataError(f"obstacles need a Robot, whose links have shapes, got {robot!r}")
        if not 0 <= clearance < np.inf:
            raise DataError(f"the clearance is a distance in metres, got {clearance!r}")
        self.robot: Robot = robot
        self.clearance = float(clearance)
        links, base = robot.model.links, robot.config()["base"]
        self.closer: Mapping[Pair, float] = MappingProxyType({})
        why: dict[Pair, str] = {}
        if isinstance(obstacles, str | os.PathLike):
            model = compile_mjcf(obstacles, "the obstacles")
            obstacles = list(solids(model, links, base, visuals))
            why = dict.fromkeys(map(_pair, excluded(model)), "excluded")
        own = [one for one in obstacles if one.carrier in links]
        if geometry is not None or not own:
            own = _own(robot, geometry, None if meshes is None else Path(meshes), visuals)
        self.shapes = (*own, *(one for one in obstacles if one.carrier not in links))
        why |= {self._known(pair): "given" for pair in allowed}
        self.allowed: Mapping[Pair, str] = MappingProxyType(why)
        pairs = _moving_pairs(robot, self.shapes)
        self.geometry = Geometry(robot, self.shapes, pairs)
        self._allow(self._always())

    @property
    def names(self) -> tuple[str, ...]:
        """Of links, objects and obstacles that have solids."""
        return tuple(dict.fromkeys(shape.name for shape in self.shapes))

    def label(self, pair: int) -> str:
        """The names of a pair in words: "l_forearm / table"."""
        return " / ".join(self.links_first(self.pairs[pair]))

    def links_first(self, pair: Pair) -> Pair:
        """A pair of names, of which a link of the robot is the first."""
        one, other = sorted(pair, key=lambda name: name not in self.robot.model.links)
        return one, other

    def objects(
        self, state: RobotState | None, frames: Mapping[str, Frame], batch: int
    ) -> dict[str, tuple[Array, Array, Array]]:
        """Positions, rotations and Jacobians of the scene's objects, of B robots.

        Parameters
        ----------
        state : RobotState, optional
            Of robots (B,), with the objects that they hold as links.
        frames : mapping of str to Frame
            Poses of the others, of shape () or (B,).
        batch : int

        Raises
        ------
        DataError
            If the pose of an object is not known.
        """
        found: dict[str, tuple[Array, Array, Array]] = {}
        still: Array = np.zeros((batch, 6, self.robot.n_joints))
        for name in self.geometry.objects:
            moved = still
            if state is not None and name in state.links:
                pose, moved = state.pose(name), state.jacobian(name).numpy(force=True)
            elif name in frames:
                pose = frames[name]
            else:
                rests = [one.rest for one in self.shapes if one.carrier == name and one.rest]
                if not rests:
                    raise DataError(
                        f"where is the object {name!r} of the scene? Poses are known of "
                        f"{sorted(frames)}; a solid that stands still has no carrier"
                    )
                pose = rests[0]
            pose = pose.expand((batch,))
            turn = quaternions.to_matrix(pose.orientation.double()).numpy(force=True)
            found[name] = pose.position.double().numpy(force=True), turn, moved
        return found

    def distances(
        self, joints: Any, frames: Mapping[str, Frame] = MappingProxyType({}),
        within: float = 1.0, state: RobotState | None = None,
    ) -> dict[Pair, Array]:  # fmt: skip
        """Distances of named pairs [m], of several postures.

        Parameters
        ----------
        joints : array-like of shape (B, n_joints)
        frames : mapping of str to Frame
            Poses of objects, of shape () or (B,).
        within : float, default=1.0
            Further apart counts as so far [m].
        state : RobotState, optional
            With held objects as links.

        Returns
        -------
        dict of (str, str) to ndarray of shape (B,)
            Of pairs that are nearer once; negative where they overlap.
        """
        postures = self.robot.joint_tensor(joints)
        objects = self.objects(state, frames, len(postures))
        placed = self.geometry.place(postures, objects)
        shape = len(postures), len(self.geometry.pairs)
        near = self.geometry.near(placed, np.full(shape, within))
        found: dict[Pair, Array] = {}
        for robot, pair, distance in zip(near.robot, near.pair, near.distance, strict=True):
            row = found.setdefault(self.pairs[pair], np.full(len(postures), within))
            row[robot] = min(row[robot], distance)
        return found

    def allowing(self, demonstrations: Iterable[Demonstration]) -> Self:
        """The scene with pairs allowed that come near each other in demonstrations.

        Pairs that overlap there do not count any more; others may come half as near as they
        did, if that is less than the clearance.

        Parameters
        ----------
        demonstrations : iterable of Demonstration
            With their frames and holds. What stands still in the scene did not stand there.
        """
        least: dict[Pair, float] = {}
        for one in demonstrations:
            chosen = one.reorder(self.robot.joint_names)
            state, frames = held_objects(
                self.robot.state(chosen.joints), one.time, one.frames, one.holds or ()
            )
            near = self.distances(chosen.joints, frames, 2 * self.clearance, state)
            for pair, values in near.items():
                least[pair] = min(least.get(pair, np.inf), float(values.min()))
        return self._near_each_other(least)

    def allowing_skill(self, skill: Any) -> Self:
        """The scene with links allowed that come near each other in a skill's demonstrations.

        For a saved skill, whose demonstrations are not at hand: it keeps some postures of them.

        Parameters
        ----------
        skill : Skill

        Warns
        -----
        PlausibilityWarning
            If it keeps none, as files that an earlier release wrote.
        """
        kept = [one.postures for one in _summaries(skill) if one is not None]
        if not any(kept):
            warnings.warn(
                "the skill keeps no postures of its demonstrations, so that no links may come "
                "near each other: fit it again, or use Scene.allowing(demonstrations)",
                PlausibilityWarning,
                stacklevel=2,
            )
            return self
        postures = np.concatenate([one for one in kept if one])
        near = self.distances(postures, self._away, 2 * self.clearance)
        return self._near_each_other({pair: float(d.min()) for pair, d in near.items()})

    def _near_each_other(self, least: Mapping[Pair, float]) -> Self:
        """The scene with pairs allowed that were shown as near as that."""
        fixed = {one.name for one in self.shapes if one.carrier is None}
        least = {pair: d for pair, d in least.items() if fixed.isdisjoint(pair)}
        other = copy.copy(self)
        other.closer = MappingProxyType(
            {**self.closer, **{pair: d for pair, d in least.items() if d > 0}}
        )
        text = "overlap by {:.0f} mm in demonstrations"
        other.geometry = copy.copy(self.geometry)
        other._allow({p: text.format(-1e3 * d) for p, d in least.items() if d <= 0})
        return other

    @property
    def _away(self) -> dict[str, Frame]:
        """Objects where they are near nothing."""
        return {name: Frame([1e3] * 3) for name in self.geometry.objects}

    def _known(self, names: Sequence[str]) -> Pair:
        """A pair of solids that exist."""
        for name in (pair := _pair(names)):
            if name not in self.names:
                raise UnknownNameError("solid", name, "the scene", self.names)
        return pair

    def _allow(self, more: Mapping[Pair, str]) -> None:
        """Leave out pairs."""
        self.allowed = MappingProxyType({**more, **self.allowed})
        names = [
            _pair([self.shapes[i].name for i in both]) for both in self.geometry.pairs.tolist()
        ]
        keep = [name not in self.allowed for name in names]
        self.geometry.pairs = self.geometry.pairs[np.array(keep, bool)]
        self.pairs = tuple(name for name, kept in zip(names, keep, strict=True) if kept)
        self.needed = np.array(
            [self.closer.get(pair, 2 * self.clearance) / 2 for pair in self.pairs]
        )

    def _always(self) -> dict[Pair, str]:
        """Links that overlap in all postures."""
        self._allow({})
        robot, links = self.robot, set(self.robot.model.links)
        draw = torch.rand(POSTURES, robot.n_joints, generator=torch.Generator().manual_seed(0))
        low, high = robot.lower.clamp(min=-torch.pi), robot.upper.clamp(max=torch.pi)
        near = self.distances(torch.lerp(low, high, draw.to(low)), self._away, 1e-3)
        return {
            pair: f"always overlap, by {-1e3 * float(values.max()):.0f} mm at least"
            for pair, values in near.items()
            if (values < 0).all() and links.issuperset(pair)
        }


def _summaries(skill: Any) -> Iterator[Any]:
    """Of the demonstrations of the skills that a skill is made of."""
    parts = getattr(skill, "skills", ())
    for one in parts:
        yield from _summaries(one)
    if not parts:
        yield skill.summary


def _pair(names: Sequence[str]) -> Pair:
    if isinstance(names, str) or len(names) != 2:
        raise DataError(f"a pair is two names, got {names!r}")
    one, other = sorted(names)
    return one, other


def _own(
    robot: Robot, geometry: str | os.PathLike[str] | None, meshes: Path | None, visuals: bool
) -> list[Shape]:
    """The solids of the robot's links."""
    text = robot.model.text if geometry is None else description_text(geometry)
    links = robot.model.links
    if parse_xml(text).tag == "mujoco":
        assert geometry is not None
        found = solids(
            compile_mjcf(geometry, "the robot"), links, robot.config()["base"], visuals
        )
    else:
        if geometry is not None and not is_text(geometry) and meshes is None:
            meshes = Path(geometry).parent
        found = iter(urdf_solids(text, meshes, visuals))
    own = [one for one in found if one.carrier in links]
    if not own:
        raise DataError(
            f"no body of the geometry has the name of a link with a solid: links are {links}"
        )
    return own


def _moving_pairs(robot: Robot, shapes: Sequence[Shape]) -> Any:
    """Pairs of solids (P, 2) whose parts move, and are not connected by one joint."""
    above = {joint.child: joint.parent for joint in robot.model.joints}
    base, model = robot.config()["base"], robot.model
    links = [one.carrier in robot.model.links for one in shapes]
    carriers = [one.carrier or base for one in shapes]
    parts = [_part(robot, name) if name in model.links else name for name in carriers]
    # the part from which the joint of a part hangs
    nearer = [_part(robot, above[part]) if part in above else "" for part in parts]
    own, near = np.unique([parts, nearer], return_inverse=True)[1].reshape(2, -1)
    first, second = np.triu_indices(len(shapes), 1)
    both = np.array(links)[first] & np.array(links)[second]
    connected = both & ((near[first] == own[second]) | (near[second] == own[first]))
    keep = (own[first] != own[second]) & ~connected
    return np.stack((first[keep], second[keep]), axis=1)


def _part(robot: Robot, link: str) -> str:
    """The uppermost link that is rigidly connected."""
    model, config = robot.model, robot.config()
    driven = set(config["joints"]).difference(config["coordinates"])
    above = {joint.child: joint for joint in model.joints}
    while (joint := above.get(link)) is not None:
        if joint.movable and model.leader(joint.name).joint in driven:
            break
        link = joint.parent
    return link
