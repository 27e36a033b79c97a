"""Makes the URDF of both ViperX arms and its light meshes, as they ship in the package, from gym-aloha's files.

Usage: python scripts/convert_arms.py FOLDER

Needs `pip install 'ugr-lightning[dev]'`. The files of the package gym-aloha are only read; it is never imported.
"""

import importlib.util
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import fast_simplification
import numpy as np
import trimesh

from ugr_lightning.embodiment import TCP_OFFSET
from ugr_lightning.sim.kinematics import (
    BASE_X,
    FINGER_CLOSED,
    FINGER_OPEN,
    SIDES,
    Array,
    rotation_x,
    rotation_y,
    rotation_z,
)

_MILLIMETRE = 0.001
_WITHOUT_COLLISION = ("1_base", "8_gripper_prop")  # inside other parts; they would only cost time
_GREY = {"8_gripper_prop": 0.25, "10_gripper_finger_left": 0.32, "10_gripper_finger_right": 0.32}
_DARK = 0.13
_FACES, _FINGER_FACES, _PART_FACES = 280, 250, 60
_BOX_FACES, _SCREW_SIZE = 12, 8.0  # fewer faces are stray triangles; mm


def convert(folder: Path) -> None:
    """Write the URDF and the meshes into a folder."""
    found = importlib.util.find_spec("gym_aloha")
    if found is None or not found.submodule_search_locations:
        sys.exit("gym-aloha is not installed: pip install --no-deps gym-aloha")
    assets = Path(next(iter(found.submodule_search_locations))) / "assets"
    dependencies = ElementTree.parse(assets / "vx300s_dependencies.xml")
    meshes = {mesh.attrib["name"]: mesh.attrib["file"] for mesh in dependencies.iter("mesh")}
    _write_meshes(assets, sorted(set(meshes.values())), folder)
    robot = ElementTree.Element("robot", name="dual_vx300s")
    ElementTree.SubElement(robot, "link", name="root")
    for side in SIDES:
        body = ElementTree.parse(assets / f"vx300s_{side}.xml").getroot().find("body")
        assert body is not None
        _add_arm(robot, side, body, meshes)
    ElementTree.indent(robot)
    ElementTree.ElementTree(robot).write(folder / "dual_vx300s.urdf")


# -------------------------------------------------------------------------------------------------------- meshes


def _write_meshes(assets: Path, names: list[str], folder: Path) -> None:
    for kind in ("visual", "collision"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for name in names:
        mesh = trimesh.load_mesh(assets / name)
        mesh.merge_vertices()
        hull = mesh.convex_hull
        hull.apply_scale(_MILLIMETRE).export(folder / "collision" / name)
        _decimate(mesh, name).apply_scale(_MILLIMETRE).export(folder / "visual" / name)


def _decimate(mesh: trimesh.Trimesh, name: str) -> trimesh.Trimesh:
    """Fewer triangles, about 3 000 an arm instead of 28 000; at 160x120 each thousand costs about 1 ms a step."""
    if "finger" in name:
        return _simplify(mesh, _FINGER_FACES)
    if "gripper" not in name:
        return _simplify(mesh, _FACES)
    # The gripper is an assembly of many solids and falls apart when simplified as one: hulls of the large ones.
    solids = [solid for solid in mesh.split(only_watertight=False) if len(solid.faces) >= _BOX_FACES]
    large = [solid for solid in solids if np.sort(solid.extents)[1] >= _SCREW_SIZE]
    hulls = [_simplify(solid.convex_hull, _PART_FACES) for solid in large]
    return trimesh.util.concatenate(hulls)  # type: ignore[return-value]


def _simplify(mesh: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    if len(mesh.faces) <= faces:
        return mesh
    points, triangles = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
    return trimesh.Trimesh(*fast_simplification.simplify(points, triangles, target_count=faces, agg=9))


# ---------------------------------------------------------------------------------------------------------- urdf


def _add_arm(robot: ElementTree.Element, side: str, body: ElementTree.Element, meshes: dict[str, str]) -> None:
    base = f"{side}_base_link"
    _add_link(robot, base, body, meshes)
    yaw, x = (0.0, -BASE_X) if side == "left" else (np.pi, BASE_X)
    _add_joint(robot, f"{side}_base", "fixed", "root", base, np.array([x, 0.0, 0.0]), rotation_z(yaw))
    for child in body.findall("body"):
        _add_body(robot, side, child, base, meshes)
    ElementTree.SubElement(robot, "link", name=f"{side}_tcp")
    _add_joint(
        robot, f"{side}_tcp", "fixed", f"{side}_gripper_link", f"{side}_tcp", np.array([TCP_OFFSET, 0, 0]), np.eye(3)
    )


def _add_body(
    robot: ElementTree.Element, side: str, body: ElementTree.Element, parent: str, meshes: dict[str, str]
) -> None:
    name = body.attrib["name"].replace(f"vx300s_{side}/", f"{side}_")
    if name.endswith("camera_focus"):
        return
    _add_link(robot, name, body, meshes)
    position, rotation = _numbers(body, "pos", 3), _rotation(body)
    joint = body.find("joint")
    if joint is None:
        _add_joint(robot, f"{name}_fixed", "fixed", parent, name, position, rotation)
    else:
        sliding = joint.get("type") == "slide"
        limits = _numbers(joint, "range", 2)
        if sliding:  # the package's own range closes the pads into each other
            limits = (
                np.array([FINGER_CLOSED, FINGER_OPEN]) if limits[0] > 0 else -np.array([FINGER_OPEN, FINGER_CLOSED])
            )
        element = _add_joint(
            robot,
            joint.attrib["name"].replace(f"vx300s_{side}/", f"{side}_"),
            "prismatic" if sliding else "revolute",
            parent,
            name,
            position,
            rotation,
        )
        ElementTree.SubElement(element, "axis", xyz=_text(_numbers(joint, "axis", 3)))
        low, high = (f"{limit:.6f}" for limit in limits)
        ElementTree.SubElement(element, "limit", lower=low, upper=high, effort="300", velocity="3.14")
    for child in body.findall("body"):
        _add_body(robot, side, child, name, meshes)


def _add_link(robot: ElementTree.Element, name: str, body: ElementTree.Element, meshes: dict[str, str]) -> None:
    link = ElementTree.SubElement(robot, "link", name=name)
    inertial = body.find("inertial")
    if inertial is not None:
        element = ElementTree.SubElement(link, "inertial")
        _add_origin(element, _numbers(inertial, "pos", 3), _rotation(inertial))
        ElementTree.SubElement(element, "mass", value=inertial.attrib["mass"])
        moments = dict(zip(("ixx", "iyy", "izz"), _numbers(inertial, "diaginertia", 3).astype(str), strict=True))
        ElementTree.SubElement(element, "inertia", **moments, ixy="0", ixz="0", iyz="0")
    for geometry in body.findall("geom"):
        mesh = geometry.attrib["mesh"]
        part = mesh.removeprefix("vx300s_")
        kinds = ("visual",) if part in _WITHOUT_COLLISION else ("visual", "collision")
        for kind in kinds:
            element = ElementTree.SubElement(link, kind)
            _add_origin(element, _numbers(geometry, "pos", 3), _rotation(geometry))
            shape = ElementTree.SubElement(element, "geometry")
            ElementTree.SubElement(shape, "mesh", filename=f"{kind}/{meshes[mesh]}")
            if kind == "visual":
                grey = _GREY.get(part, _DARK)
                material = ElementTree.SubElement(element, "material", name=mesh)
                ElementTree.SubElement(material, "color", rgba=f"{grey} {grey} {grey + 0.01} 1")


def _add_joint(
    robot: ElementTree.Element, name: str, kind: str, parent: str, child: str, position: Array, rotation: Array
) -> ElementTree.Element:
    joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    _add_origin(joint, position, rotation)
    return joint


def _add_origin(element: ElementTree.Element, position: Array, rotation: Array) -> None:
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[2, 1], rotation[2, 2]))
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    ElementTree.SubElement(element, "origin", xyz=_text(position), rpy=_text(np.array([roll, pitch, yaw])))


def _rotation(element: ElementTree.Element) -> Array:
    if "quat" in element.attrib:
        w, x, y, z = (q := _numbers(element, "quat", 4)) / np.linalg.norm(q)
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
    roll, pitch, yaw = _numbers(element, "euler", 3)  # MuJoCo's default: intrinsic x, y, z
    return rotation_x(roll) @ rotation_y(pitch) @ rotation_z(yaw)


def _numbers(element: ElementTree.Element, key: str, count: int) -> Array:
    text = element.get(key)
    return np.array(text.split(), dtype=np.float64) if text else np.zeros(count)


def _text(values: Array) -> str:
    return " ".join(f"{value:.6f}" for value in values)


if __name__ == "__main__":
    convert(Path(sys.argv[1]))
