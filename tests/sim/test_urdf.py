import xml.etree.ElementTree as ElementTree
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import trimesh

from ugr_lightning.errors import SimulationError
from ugr_lightning.sim import urdf
from ugr_lightning.sim.kinematics import HOME, forward, rotation_from_vector, to_world


def numbers(element, key):
    return np.array(element.get(key).split(), float)


def rotation_of(origin):
    roll, pitch, yaw = numbers(origin, "rpy")
    turns = (np.array(v) for v in ([0, 0, yaw], [0, pitch, 0], [roll, 0, 0]))
    first, second, third = (rotation_from_vector(turn) for turn in turns)
    return first @ second @ third


def tool_pose(path, side, joints):
    """Follow the joints of the file from the tool to the root."""
    root = ElementTree.parse(path).getroot()
    by_child = {joint.find("child").get("link"): joint for joint in root.iter("joint")}
    names = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
    values = {f"{side}_{name}": value for name, value in zip(names, joints, strict=True)}
    pose, link = np.eye(4), f"{side}_tcp"
    while link != "root":
        joint = by_child[link]
        step = np.eye(4)
        step[:3, 3] = numbers(joint.find("origin"), "xyz")
        step[:3, :3] = rotation_of(joint.find("origin"))
        if joint.get("name") in values:
            step[:3, :3] = step[:3, :3] @ rotation_from_vector(
                numbers(joint.find("axis"), "xyz") * values[joint.get("name")]
            )
        pose, link = step @ pose, joint.find("parent").get("link")
    return pose


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("joints", [HOME, np.array([0.4, -0.3, 0.6, 0.8, 0.5, -1.1])])
def test_the_file_and_the_closed_form_agree_on_where_the_tool_is(side, joints):
    expected = to_world(side, forward(joints))
    found = tool_pose(urdf.dual_arm_urdf(), side, joints)
    np.testing.assert_allclose(found[:3, 3], expected.position, atol=1e-5)
    np.testing.assert_allclose(found[:3, :3], expected.rotation, atol=1e-5)


def test_visual_meshes_are_light_and_all_mesh_files_exist():
    path = urdf.dual_arm_urdf()
    names = [mesh.get("filename") for mesh in ElementTree.parse(path).getroot().iter("mesh")]
    assert all((path.parent / name).is_file() for name in names)
    visual = sorted({name for name in names if name.startswith("visual/")})
    assert sum(len(trimesh.load_mesh(path.parent / name).faces) for name in visual) < 5000


def test_processes_that_start_together_share_one_complete_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with ThreadPoolExecutor(3) as pool:
        paths = set(pool.map(lambda _: urdf.dual_arm_urdf(), range(3)))
    assert len(paths) == 1
    assert [path.name for path in (tmp_path / "ugr-lightning").iterdir()] == [paths.pop().parent.name]


def test_another_version_of_the_conversion_has_another_cache_entry(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(urdf, "_convert", lambda assets, folder: (folder / "dual_vx300s.urdf").touch())
    first = urdf.dual_arm_urdf()
    monkeypatch.setattr(urdf, "VERSION", urdf.VERSION + 1)
    assert urdf.dual_arm_urdf() != first


def test_a_missing_gym_aloha_says_how_to_install_it(monkeypatch):
    monkeypatch.setattr(urdf.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SimulationError, match="pip install gym-aloha"):
        urdf.dual_arm_urdf()
