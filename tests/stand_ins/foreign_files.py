"""Small demonstrations in the layouts of other projects, of robots with any number of joints and any cameras."""

import io
import json

import h5py
import numpy as np
from PIL import Image

SIZE = (24, 32)
ACT_CAMERAS = ("cam_high", "cam_right_wrist", "cam_left_wrist")
ROBOTWIN_CAMERAS = ("head_camera", "right_camera", "left_camera")


def waves(steps, width, seed=0):
    """Joints that move slowly, (steps, width) float32."""
    return (0.3 * np.sin(0.15 * np.arange(steps)[:, None] + np.arange(width) + 0.7 * seed)).astype(np.float32)


def pictures(steps, size=SIZE, seed=0):
    """Pictures that move, (steps, H, W, 3) uint8."""
    y, x = np.mgrid[: size[0], : size[1]]
    shade = x * 3 + y + 11 * seed + 7 * np.arange(steps)[:, None, None]  # (steps, H, W)
    return (np.stack([shade, shade + 60, shade + 120], -1) % 256).astype(np.uint8)


def swapped_jpeg(picture):
    """A true RGB picture given to an encoder that takes it for BGR, as RoboTwin and ALOHA store them."""
    out = io.BytesIO()
    Image.fromarray(picture[..., ::-1]).save(out, "JPEG", quality=95)
    return out.getvalue()


def marked_jpeg(jpeg):
    """The same picture with the mark of true RGB, as XPolicyLab stores them."""
    return jpeg[:2] + b"\xff\xfe\x00\x0aXPL-RGB1" + jpeg[2:]


def jpeg_rows(jpegs):
    """Rows of bytes, with zeros behind."""
    rows = np.zeros((len(jpegs), max(map(len, jpegs))), np.uint8)
    for row, jpeg in zip(rows, jpegs, strict=True):
        row[: len(jpeg)] = np.frombuffer(jpeg, np.uint8)
    return rows


def write_act(
    folder, count=5, steps=14, width=14, cameras=ACT_CAMERAS, sizes=None, name="episode_{}.hdf5", compress=False,
    dtype=np.float32, original=False,
):  # fmt: skip
    """ACT's files; `sizes` by camera where not 24x32, `compress` as act-plus-plus does."""
    folder.mkdir(parents=True, exist_ok=True)
    for episode in range(count):
        with h5py.File(folder / name.format(episode), "w") as file:
            joints = waves(steps + 1, width, episode)
            joints = (100 * joints).astype(dtype) if np.dtype(dtype).kind == "i" else joints.astype(dtype)
            file["observations/qpos"], file["action"] = joints[:-1], joints[1:]
            if original:
                file["observations/qvel"] = np.zeros((steps, width), np.float32)
            for number, camera in enumerate(cameras):
                shown = pictures(steps, (sizes or {}).get(camera, SIZE), 5 * episode + number)
                file[f"observations/images/{camera}"] = jpeg_rows(list(map(swapped_jpeg, shown))) if compress else shown
            if compress:
                file.attrs["compress"] = True
                file["compress_len"] = np.full((len(cameras), steps), 1.0)
    return folder


def write_robotwin(folder, count=5, steps=14, joints=6, cameras=ROBOTWIN_CAMERAS, sizes=None):
    """RoboTwin's raw files of two arms."""
    (folder / "data").mkdir(parents=True, exist_ok=True)
    for episode in range(count):
        with h5py.File(folder / f"data/episode{episode}.hdf5", "w") as file:
            vector = waves(steps + 1, 2 * joints + 2, episode).astype(np.float64)
            for side, first in (("left", 0), ("right", joints + 1)):
                file[f"joint_action/{side}_arm"] = vector[:, first : first + joints]
                file[f"joint_action/{side}_gripper"] = vector[:, first + joints]
            file["joint_action/vector"] = vector
            for number, camera in enumerate(cameras):
                shown = pictures(steps + 1, (sizes or {}).get(camera, SIZE), 5 * episode + number)
                file[f"observation/{camera}/rgb"] = np.array(list(map(swapped_jpeg, shown)), dtype=bytes)
    return folder


def write_maniskill(folder, name="trajectory", count=4, steps=12, mode="pd_joint_pos", rgb=True):
    """One file of ManiSkill's recorder: nine joints, eight commands, and what was observed beside them."""
    folder.mkdir(parents=True, exist_ok=True)
    with h5py.File(folder / f"{name}.h5", "w") as file:
        for episode in range(count):
            group = file.create_group(f"traj_{episode}")
            group["actions"], group["obs/agent/qpos"] = waves(steps, 8, episode), waves(steps + 1, 9, episode)
            group["obs/extra/tcp_pose"] = waves(steps + 1, 7, episode + 1)
            group["obs/extra/is_grasped"] = np.arange(steps + 1) > 5
            if rgb:
                group["obs/sensor_data/base_camera/rgb"] = pictures(steps + 1, seed=episode)
    entries = [{"episode_id": e, "episode_seed": e, "control_mode": mode, "elapsed_steps": steps} for e in range(count)]
    (folder / f"{name}.json").write_text(json.dumps({"env_info": {"env_id": "Cube-v1"}, "episodes": entries}))
    return folder


def replace(key, *arguments, **options):
    """Damage to an open file: another dataset at `key`, given as to `create_dataset`."""

    def damage(file):
        del file[key]
        file.create_dataset(key, *arguments, **options)

    return damage


def poke(key, where, value):
    """Damage to an open file: another value at one place of a dataset."""
    return lambda file: file[key].__setitem__(where, value)
