"""Procedural props: simple solids and turned shapes joined to one rigid body, no files."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building.actor_builder import ActorBuilder
from mani_skill.utils.structs import Actor

from ugr_lightning.sim.kinematics import Array, rotation_y, rotation_z
from ugr_lightning.sim.settings import Colour

DENSITY = 400.0  # kg / m^3
_SIDES_OF_A_CIRCLE = 32
_X_TO = {"x": np.eye(3), "y": rotation_z(np.pi / 2.0), "z": rotation_y(-np.pi / 2.0)}  # SAPIEN's cylinders lie along x


def pose_of(position: Sequence[float] | Array, rotation: Array | None = None) -> sapien.Pose:
    """A SAPIEN pose of a position (3,) in metres and a rotation matrix (3, 3)."""
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3] = np.eye(3) if rotation is None else rotation
    matrix[:3, 3] = position
    return sapien.Pose(matrix)


class Prop:
    """A rigid body under construction.

    Args:
        scene: the scene it will stand in.
        friction: static and dynamic friction of its surface.
        density: kg / m^3.
        builder: what the shapes are added to, e.g. a link of an articulation; by default a new actor.
    """

    def __init__(
        self,
        scene: ManiSkillScene,
        *,
        friction: float = 1.0,
        density: float = DENSITY,
        builder: ActorBuilder | None = None,
    ) -> None:
        self._builder = scene.create_actor_builder() if builder is None else builder
        self._material = sapien.physx.PhysxMaterial(friction, friction, 0.0)
        self._density = density
        self._renders = scene.can_render()

    def box(
        self,
        size: tuple[float, float, float],
        at: tuple[float, float, float],
        colour: Colour | None,
        *,
        rotation: Array | None = None,
        solid: bool = True,
    ) -> "Prop":
        """Add a box.

        Args:
            size: edge lengths in metres.
            at: its centre in the prop's frame.
            colour: RGB 0 .. 1, or None for an invisible one.
            rotation: (3, 3) orientation in the prop's frame.
            solid: whether it collides.
        """
        pose, half = pose_of(at, rotation), [edge / 2.0 for edge in size]
        return self._add("box", pose, (half,), colour, solid)

    def cylinder(
        self,
        radius: float,
        length: float,
        at: tuple[float, float, float],
        colour: Colour | None,
        *,
        axis: str = "z",
        solid: bool = True,
    ) -> "Prop":
        """Add a cylinder along the axis `x`, `y` or `z`; the other arguments as for `box`."""
        return self._add("cylinder", pose_of(at, _X_TO[axis]), (radius, length / 2.0), colour, solid)

    def capsule(
        self,
        start: Sequence[float] | Array,
        end: Sequence[float] | Array,
        radius: float,
        colour: Colour | None,
        *,
        solid: bool = True,
    ) -> "Prop":
        """Add a rod with round ends between two points (3,); the other arguments as for `box`.

        A chain of rods makes a bent tube, such as the handle of a mug.
        """
        line = np.subtract(end, start)
        length = float(np.linalg.norm(line))
        pose = pose_of(np.add(start, end) / 2.0, _frame_along(line / length))
        return self._add("capsule", pose, (radius, length / 2.0), colour, solid)

    def lathe(
        self, profile: Sequence[tuple[float, float]], colour: Colour, at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> "Prop":
        """Add the look of a turned shape, such as a bottle; it does not collide, so add invisible solids inside it.

        Args:
            profile: (radius, height) points in metres, along the outline from the bottom to the top of what is seen;
                a cup goes on down its inner wall. Edges are sharp.
            colour: RGB 0 .. 1.
            at: the origin of the profile in the prop's frame.
        """
        if self._renders:
            vertices, triangles, normals = _turned(np.asarray(profile, np.float64))
            uvs = np.zeros((len(vertices), 2), np.float32)
            shape = sapien.render.RenderShapeTriangleMesh(vertices, triangles, normals, uvs, self._paint(colour))
            shape.local_pose = pose_of(at)
            self._builder._procedural_shapes.append(shape)
        return self

    def build(self, name: str, pose: sapien.Pose, *, static: bool = False) -> Actor:
        """Put the prop into the scene."""
        self._builder.initial_pose = pose
        return self._builder.build_static(name=name) if static else self._builder.build(name=name)

    def _add(self, kind: str, pose: sapien.Pose, sizes: tuple[Any, ...], colour: Colour | None, solid: bool) -> "Prop":
        """Add a shape that SAPIEN knows by name, in half sizes."""
        if solid:
            collide = getattr(self._builder, f"add_{kind}_collision")
            collide(pose, *sizes, material=self._material, density=self._density)
        if colour is not None:
            getattr(self._builder, f"add_{kind}_visual")(pose, *sizes, material=self._paint(colour))
        return self

    def _paint(self, colour: Colour) -> "sapien.render.RenderMaterial | None":
        return sapien.render.RenderMaterial(base_color=[*colour, 1.0]) if self._renders else None


def _frame_along(direction: Array) -> Array:
    """A rotation matrix whose x axis is the given unit vector."""
    other = np.array([0.0, 0.0, 1.0]) if abs(direction[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    y = np.cross(other, direction)
    y /= np.linalg.norm(y)
    return np.stack([direction, y, np.cross(direction, y)], axis=1)


def _turned(profile: Array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (n, 3), triangles (m, 3) and normals (n, 3) of an outline turned about z, facing right of its course.

    Each piece of the outline has vertices of its own, so that light breaks at its edges.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, _SIDES_OF_A_CIRCLE + 1)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)  # (n, 2)
    vertices: list[Array] = []
    triangles: list[Array] = []
    normals: list[Array] = []
    for (r0, z0), (r1, z1) in itertools.pairwise(profile):
        outwards, upwards = np.array([z1 - z0, r0 - r1]) / np.hypot(r1 - r0, z1 - z0)
        base, n = len(vertices) * 2 * len(circle), len(circle)
        rings = [np.column_stack([circle * r, np.full(n, z)]) for r, z in ((r0, z0), (r1, z1))]
        vertices.append(np.concatenate(rings))  # (2 n, 3)
        normals.append(np.tile(np.column_stack([circle * outwards, np.full(n, upwards)]), (2, 1)))
        k = base + np.arange(n - 1)
        triangles.append(np.column_stack([k, k + 1, k + n + 1]))
        triangles.append(np.column_stack([k, k + n + 1, k + n]))
    return (
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(triangles).astype(np.uint32),
        np.concatenate(normals).astype(np.float32),
    )
