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
    dtype=np.float32, original=False, simulated=True,
):  # fmt: skip
    """ACT's files; `sizes` by camera where not 24x32, `compress` as act-plus-plus does, `original` as its recorder."""
    folder.mkdir(parents=True, exist_ok=True)
    for episode in range(count):
        with h5py.File(folder / name.format(episode), "w") as file:
            joints = waves(steps + 1, width, episode)
            joints = (100 * joints).astype(dtype) if np.dtype(dtype).kind == "i" else joints.astype(dtype)
            file["observations/qpos"], file["action"] = joints[:-1], joints[1:]
            if original:
                file["observations/qvel"], file.attrs["sim"] = waves(steps, width, episode + 100), simulated
            for number, camera in enumerate(cameras):
                shown = pictures(steps, (sizes or {}).get(camera, SIZE), 5 * episode + number)
                rows = jpeg_rows(list(map(swapped_jpeg, shown))) if compress else shown
                chunks = (1, *rows.shape[1:]) if original else None
                file.create_dataset(f"observations/images/{camera}", data=rows, chunks=chunks)
            if compress:
                file.attrs["compress"] = True
                file["compress_len"] = np.full((len(cameras), steps), 1.0)
    return folder


def write_robotwin(folder, count=5, steps=14, joints=6, cameras=ROBOTWIN_CAMERAS, sizes=None, name="episode{}.hdf5"):
    """RoboTwin's raw files of two arms, whose hands point down."""
    (folder / "data").mkdir(parents=True, exist_ok=True)
    for episode in range(count):
        with h5py.File(folder / "data" / name.format(episode), "w") as file:
            vector = waves(steps + 1, 2 * joints + 2, episode).astype(np.float64)
            for side, first in (("left", 0), ("right", joints + 1)):
                file[f"joint_action/{side}_arm"] = vector[:, first : first + joints]
                file[f"joint_action/{side}_gripper"] = file[f"endpose/{side}_gripper"] = vector[:, first + joints]
                pose = [0.1, 0.2, 1, 0.5**0.5, 0, 0.5**0.5, 0]
                file[f"endpose/{side}_endpose"] = np.tile(pose, (steps + 1, 1))
            file["joint_action/vector"], file["pointcloud"] = vector, np.zeros((steps + 1, 0))
            for number, camera in enumerate(cameras):
                shown = pictures(steps + 1, (sizes or {}).get(camera, SIZE), 5 * episode + number)
                file[f"observation/{camera}/rgb"] = np.array(list(map(swapped_jpeg, shown)), dtype=bytes)
    (folder / "seed.txt").write_text(" ".join(str(4 + 5 * episode) for episode in range(count)))
    return folder


def write_maniskill(
    folder, name="trajectory", lengths=(12, 12, 12, 12), mode="pd_joint_pos", width=8, qpos=9,
    cameras=("base_camera",), skip=(),
):  # fmt: skip
    """One file of ManiSkill's recorder: trajectories of these many steps, and what was observed beside the joints."""
    folder.mkdir(parents=True, exist_ok=True)
    episodes = []
    with h5py.File(folder / f"{name}.h5", "w") as file:
        for number, steps in enumerate(lengths):
            if number in skip:
                continue
            group = file.create_group(f"traj_{number}", track_order=True)
            group["actions"] = waves(steps, width, 100 + number)
            group["obs/agent/qpos"] = waves(steps + 1, qpos, number)
            group["obs/extra/is_grasped"] = np.arange(steps + 1) > 5
            group["obs/extra/tcp_pose"] = waves(steps + 1, 7, number + 1)
            for place, camera in enumerate(cameras):
                shown, rgb = pictures(steps + 1, seed=5 * number + place), f"obs/sensor_data/{camera}/rgb"
                group.create_dataset(rgb, data=shown, compression="gzip", compression_opts=5)
            for flag in ("terminated", "truncated", "success"):
                group[flag] = np.arange(steps) == steps - 1
            group["rewards"] = np.zeros(steps, np.float32)
            about = {"episode_id": number, "episode_seed": 40 + number, "control_mode": mode, "elapsed_steps": steps}
            episodes.append(about | {"reset_kwargs": {"options": None, "seed": 40 + number}, "success": True})
    info = {"env_id": "Press-v1", "env_kwargs": {"obs_mode": "rgb"}, "max_episode_steps": 50}
    (folder / f"{name}.json").write_text(json.dumps({"env_info": info, "commit_info": None, "episodes": episodes}))
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
