"""Procedural props: boxes and cylinders joined to one rigid body, no files."""

from collections.abc import Sequence

import numpy as np
import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor

from ugr_lightning.sim.kinematics import Array, rotation_y, rotation_z

Colour = tuple[float, float, float]
DENSITY = 400.0  # kg / m^3
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
    """

    def __init__(self, scene: ManiSkillScene, *, friction: float = 1.0, density: float = DENSITY) -> None:
        self._builder = scene.create_actor_builder()
        self._material = sapien.physx.PhysxMaterial(friction, friction, 0.0)
        self._density = density
        self._renders = scene.can_render()

    def box(
        self,
        size: tuple[float, float, float],
        at: tuple[float, float, float],
        colour: Colour | None,
        *,
        solid: bool = True,
    ) -> "Prop":
        """Add a box.

        Args:
            size: edge lengths in metres.
            at: its centre in the prop's frame.
            colour: RGB 0 .. 1, or None for an invisible one.
            solid: whether it collides.
        """
        pose, half = pose_of(at), [edge / 2.0 for edge in size]
        if solid:
            self._builder.add_box_collision(pose, half, material=self._material, density=self._density)
        if colour is not None:
            self._builder.add_box_visual(pose, half, material=self._paint(colour))
        return self

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
        pose = pose_of(at, _X_TO[axis])
        if solid:
            self._builder.add_cylinder_collision(
                pose, radius, length / 2.0, material=self._material, density=self._density
            )
        if colour is not None:
            self._builder.add_cylinder_visual(pose, radius, length / 2.0, material=self._paint(colour))
        return self

    def build(self, name: str, pose: sapien.Pose, *, static: bool = False) -> Actor:
        """Put the prop into the scene."""
        self._builder.initial_pose = pose
        return self._builder.build_static(name=name) if static else self._builder.build(name=name)

    def _paint(self, colour: Colour) -> "sapien.render.RenderMaterial | None":
        return sapien.render.RenderMaterial(base_color=[*colour, 1.0]) if self._renders else None
