"""The room around a task, built: table, walls, clutter, lights."""

from mani_skill.envs.scene import ManiSkillScene

from ugr_lightning.embodiment import BASE_X
from ugr_lightning.sim.kinematics import rotation_z
from ugr_lightning.sim.objects import Colour, Prop, pose_of
from ugr_lightning.sim.settings import TABLE_SIZE, Clutter, Surroundings

CLUTTER_NAME = "clutter"
"""First part of the name of each piece of clutter."""

_PLINTH = (0.24, 0.20)
_DARK: Colour = (0.2, 0.2, 0.22)


def furnish(scene: ManiSkillScene, look: Surroundings) -> None:
    """Build what an episode's task is surrounded by. The table top is z = 0, whatever its height in the room.

    A lower table is built as arms, floor and camera that stand higher above it: the tasks' heights stay what they are.
    """
    table = Prop(scene).box(TABLE_SIZE, (0.0, 0.0, -TABLE_SIZE[2] / 2.0), look.table)
    table.build("table", pose_of((0.0, 0.0, 0.0)), static=True)
    room = Prop(scene)
    for x, y in ((2.0, 0.0), (-2.0, 0.0), (0.0, 2.0), (0.0, -2.0)):  # the shader's sky is black
        size = (0.02 if x else 4.0, 0.02 if y else 4.0, 4.0)
        room.box(size, (x, y, 1.0), look.wall, solid=False)
    room.box((4.0, 4.0, 0.02), (0.0, 0.0, -0.75), look.floor, solid=False)
    room.box((4.0, 4.0, 0.02), (0.0, 0.0, 2.5), look.wall, solid=False)
    if look.table_drop > 0.0:
        for x in (-BASE_X, BASE_X):
            room.box((*_PLINTH, look.table_drop), (x, 0.0, -look.table_drop / 2.0), _DARK, solid=False)
    room.build("room", pose_of((0.0, 0.0, look.table_drop)), static=True)
    for number, item in enumerate(look.clutter):
        _place(scene, item, f"{CLUTTER_NAME}_{number}")


def is_furniture(name: str) -> bool:
    """Whether an actor of a scene belongs to the room and not to the task."""
    return name in ("table", "room") or name.startswith(CLUTTER_NAME)


def illuminate(scene: ManiSkillScene, look: Surroundings) -> None:
    """Add an episode's lights; only where there is a renderer."""
    scene.set_ambient_light(list(look.ambient))
    for light in look.lights:
        scene.add_directional_light(list(light.direction), list(light.colour))


def _place(scene: ManiSkillScene, item: Clutter, name: str) -> None:
    """Build one piece of clutter, solid and fixed to the table."""
    prop, radius, height = Prop(scene), item.width / 2.0, item.height
    if item.kind == "box":
        prop.box((1.4 * radius, radius, height), (0.0, 0.0, height / 2.0), item.colour)
    elif item.kind == "book":
        prop.box((1.6 * radius, 1.2 * radius, height), (0.0, 0.0, height / 2.0), item.colour)
        prop.box((1.55 * radius, 1.21 * radius, 0.8 * height), (0.01 * radius, 0.0, height / 2.0), (0.9, 0.9, 0.85))
    else:
        shown = item.colour if item.kind == "can" else None
        prop.cylinder(radius, height, (0.0, 0.0, height / 2.0), shown)
    if item.kind == "bottle":
        shoulder, neck = 0.6 * height, 0.35 * radius
        prop.lathe(
            [(0.0, 0.0), (radius, 0.0), (radius, shoulder), (neck, 0.8 * height), (neck, height), (0.0, height)],
            item.colour,
        )
    elif item.kind == "bowl":
        inner, bottom = [(0.9 * radius, height), (0.4 * radius, 0.2 * height)], (0.0, 0.15 * height)
        prop.lathe([(0.0, 0.0), (0.5 * radius, 0.0), (radius, height), *inner, bottom], item.colour)
    prop.build(name, pose_of((item.x, item.y, 0.0), rotation_z(item.yaw)), static=True)
