"""A stand-in for XPolicyLab's side: its client over a real websocket, its environments and its evaluation loop."""

import asyncio
import contextlib
import threading
import uuid

import msgpack
import numpy as np
from robotwin_environment import TaskEnv
from websockets.sync.client import connect

from ugr_lightning.bridges.xpolicylab.server import PolicyServer


@contextlib.contextmanager
def served(model):
    """A policy server in a thread of its own, until the block ends."""
    server, loop, started = PolicyServer(model, port=0), asyncio.new_event_loop(), threading.Event()
    task = loop.create_task(server.serve(lambda _: started.set()))

    def run():
        with contextlib.suppress(asyncio.CancelledError):
            loop.run_until_complete(task)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert started.wait(60)
        yield server
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()
        loop.close()


def array_to_map(value):
    """As the package msgpack-numpy writes arrays."""
    if isinstance(value, np.ndarray):
        data = {b"nd": True, b"type": value.dtype.str, b"kind": b"", b"shape": value.shape, b"data": value.tobytes()}
        return data
    return {b"nd": False, b"type": value.dtype.str, b"data": value.tobytes()}


def map_to_array(found):
    if found.get(b"nd") is True:
        return np.frombuffer(found[b"data"], found[b"type"]).reshape(found[b"shape"])
    return found


def encode(message):
    return msgpack.packb(message, default=array_to_map, use_bin_type=True)


def decode(frame):
    return msgpack.unpackb(frame, object_hook=map_to_array)


def request(kind, payload=None, *, trial="trial", step=0, name=None, **more):
    names = {"message_id": name or str(uuid.uuid4()), "evaluation_id": "evaluation", "trial_id": trial}
    rest = {"action_case_id": None, "repeat_index": None, "sent_at": "2026-07-22T00:00:00+00:00"}
    return {"message_type": kind, **names, **rest, "step": step, "payload": payload or {}, **more}


def observation(picture, joints, index=0):
    """One of XPolicyLab's observations, version 1.0; `picture` is of the head camera."""
    joints = np.asarray(joints, np.float32)
    vision = {name: {"color": picture, "shape": picture.shape[:2]} for name in ("cam_left_wrist", "cam_right_wrist")}
    vision["cam_head"] = {"color": picture, "depth": picture[..., :1], "intrinsic_matrix": [[1.0, 0, 0]] * 3}
    state = {"left_arm_joint_state": joints[:6], "left_ee_joint_state": joints[6:7], "left_ee_pose": np.ones(7)}
    state |= {"right_arm_joint_state": joints[7:13], "right_ee_joint_state": joints[13:], "right_ee_pose": np.ones(7)}
    info = {"instruction": "click", "additional_info": {"frequency": 30}, "data_format_version": "v1.0"}
    return {"vision": vision, "state": state, "env_idx": index, **info}


def joints_of(action):
    """The vector (14,) of one action, whose parts have to be exactly these."""
    parts = ("left_arm_joint_state", "left_ee_joint_state", "right_arm_joint_state", "right_ee_joint_state")
    assert tuple(action) == parts
    assert [np.shape(action[part]) for part in parts] == [(6,), (1,), (6,), (1,)]
    return np.concatenate([action[part] for part in parts])


class Client:
    """A client of one server for one trial; `call` does what XPolicyLab's does (XPolicyLab/XPolicyLab@7198143)."""

    def __init__(self, url, trial="trial"):
        self.url, self.trial, self.step = url, trial, 0
        self.latest, self.latest_batch = None, []
        self.connection = None
        self.reconnect()

    def reconnect(self):
        if self.connection is not None:
            self.connection.close()
        self.connection = connect(self.url, max_size=None, compression=None)
        assert self.ask("hello")["payload"]["ok"] is True

    def close(self):
        self.connection.close()

    def ask(self, kind, payload=None, **more):
        message = request(kind, payload, trial=self.trial, **more)
        self.connection.send(encode(message))
        reply = decode(self.connection.recv(timeout=60))
        assert reply["message_id"] == message["message_id"], "every reply names its request"
        assert reply["trial_id"] == self.trial
        return reply

    def infer(self, obs, **more):
        reply = self.ask("infer", {"observation": obs}, step=self.step, **more)
        assert reply["message_type"] == "infer_result", reply["payload"]
        return reply["payload"]["actions"]

    def call(self, func_name=None, obs=None):
        if func_name == "reset":
            self.step = 0
            assert self.ask("reset")["message_type"] == "reset_result"
        elif func_name == "update_obs":
            self.latest = obs
        elif func_name == "update_obs_batch":
            self.latest_batch = list(obs)
        elif func_name == "get_action":
            actions = self.infer(self.latest)
            self.step += 1
            return actions
        elif func_name == "get_action_batch":
            batch = [self.infer(one) for one in self.latest_batch]
            self.step += 1
            return batch
        return None


class AugustClient(Client):
    """What XPolicyLab's client does since August 2026: every function of the model is a `call`."""

    def call(self, func_name=None, obs=None, **more):
        if func_name == "reset":
            self.step = 0
            assert self.ask("reset")["message_type"] == "reset_result"
            return None
        reply = self.ask(
            "call", {"func_name": func_name} | ({} if obs is None else {"obs": obs}), step=self.step, **more
        )
        if reply["message_type"] == "error":
            raise RuntimeError(reply["payload"]["code"], reply["payload"]["message"])
        assert reply["message_type"] == "call_result"
        assert reply["payload"]["ok"] is True
        self.step += func_name.startswith("get_action")
        return reply["payload"].get("result")


class Direct:
    """XPolicyLab's client for a model in the same process."""

    def __init__(self, model):
        self.model = model

    def call(self, func_name=None, obs=None):
        method = getattr(self.model, func_name)
        return method() if obs is None else method(obs)


class Environments:
    """XPolicyLab's TASK_ENV over simulators of ours, one per seed; each ends by itself."""

    def __init__(self, simulators, seeds):
        self.environments = [TaskEnv(simulator) for simulator in simulators]
        for environment, seed in zip(self.environments, seeds, strict=True):
            environment.setup_demo(seed)

    def _over(self, index):
        environment = self.environments[index]
        return environment.eval_success or environment.take_action_cnt >= environment.step_lim

    def is_episode_end(self):
        return not self.get_running_env_idx_list()

    def get_running_env_idx_list(self):
        return [index for index in range(len(self.environments)) if not self._over(index)]

    def get_obs(self, index=0):
        seen = self.environments[index].get_obs()
        one = observation(np.zeros((2, 2, 3), np.uint8), seen["joint_action"]["vector"], index)
        for name, theirs in (("head", "head"), ("left_wrist", "left"), ("right_wrist", "right")):
            view = seen["observation"][f"{theirs}_camera"]
            calibration = {"intrinsic_matrix": view["intrinsic_cv"], "extrinsics_matrix": view["extrinsic_cv"]}
            one["vision"][f"cam_{name}"] |= {"color": view["rgb"], **calibration}
        return one

    def get_obs_batch(self, indices):
        return [self.get_obs(index) for index in indices]

    def take_action(self, action, index=0):
        self.environments[index].take_action(joints_of(action))

    def take_action_batch(self, actions, indices):
        assert not any(self._over(index) for index in indices), "an environment that has ended gets no action"
        for action, index in zip(actions, indices, strict=True):
            self.take_action(action, index)

    def outcomes(self):
        return [(one.eval_success, one.take_action_cnt, one.motion_hash()) for one in self.environments]
