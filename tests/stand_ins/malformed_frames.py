"""Frames that a policy server has to refuse."""

import os
import pickle

import msgpack
import numpy as np
from xpolicylab_client import decode, encode, request

PARTS = (("arm", 6), ("ee", 1))


class Code:
    """Unpickling it would leave a folder behind."""

    def __init__(self, folder):
        self.folder = str(folder)

    def __reduce__(self):
        return os.mkdir, (self.folder,)


def malformed(rng, trap, seen):
    """Frames that are wrong in one way each; `seen` is a sound observation, `trap` a folder that must never appear."""
    good = request("infer", {"observation": seen}, step=0)
    whole, pickled = encode(good), pickle.dumps(Code(trap))

    def infer(**changes):
        return encode(request("infer", {"observation": seen | changes}))

    def array(**changes):
        wrong = {b"nd": True, b"type": "<f4", b"kind": b"", b"shape": [2], b"data": b"12345678"}
        return encode({**good, "payload": {"observation": wrong | {k.encode(): v for k, v in changes.items()}}})

    yield rng.bytes(int(rng.integers(0, 400)))
    yield whole[: int(rng.integers(0, len(whole)))]
    yield whole + rng.bytes(3)
    flipped = bytearray(whole[:300])
    flipped[int(rng.integers(0, 60))] ^= 1 << int(rng.integers(0, 8))
    yield bytes(flipped)
    yield "a text"
    yield pickled
    yield msgpack.packb([1, 2, 3])
    yield msgpack.packb({1: 2})
    yield b"\x91" * 2000
    yield b"\xdd\xff\xff\xff\xff"
    yield b"\xc6\xff\xff\xff\xff"
    yield msgpack.packb(list(range(5000)))
    yield msgpack.packb(msgpack.ExtType(42, pickled))
    yield array(kind=b"O", type="|O", data=pickled)
    yield array(type="|O", data=pickled)
    yield array(shape=[10**12])
    yield array(shape=[-1])
    yield array(shape=[1] * 40)
    yield array(shape="2")
    yield array(type="f4,f4")
    yield array(type="<f1")
    yield array(type=[["a", "<f4"]])
    yield array(data="12345678")
    yield encode({**good, "surprise": 1})
    yield encode({**good, "message_type": None})
    yield encode({**good, "message_type": "x" * 300})
    yield encode({**good, "message_type": "delete_everything"})
    yield encode({**good, "message_type": "infer_result"})
    yield encode({**good, "step": -1})
    yield encode({**good, "step": True})
    yield encode({**good, "payload": [1]})
    yield encode({name: value for name, value in good.items() if name != "evaluation_id"})
    yield encode(request("call"))
    yield encode(request("call", {"func_name": "update_obs"}))
    yield encode(request("call", {"func_name": "update_obs_batch", "obs": {"a": 1}}))
    yield encode(request("call", {"func_name": "get_action_batch", "obs": [["x"]]}))
    yield encode(request("call", {"func_name": "os.system", "obs": "true"}))
    yield infer(vision={"cam_head": b"\xff\xd8no picture\xff\xd9"})
    yield encode(request("infer"))
    yield encode(request("infer", {"observation": 7}))
    yield infer(vision={})
    yield infer(vision=3)
    yield infer(vision={"cam_head": {"color": "red"}})
    yield infer(state={})
    yield infer(state={"left_arm_joint_state": "x"})
    yield infer(state={f"{s}_{p}_joint_state": np.full(n, np.nan) for s in ("left", "right") for p, n in PARTS})
    yield infer(env_idx=-1)
    yield infer(env_idx="two")
    yield infer(env_idx=[0])


def refused(connection, count, rng, trap, seen):
    """Send this many frames of `malformed`, or a few more; each gets an error that tells nothing of the inside."""
    done = 0
    while done < count:
        frames = list(malformed(rng, trap, seen))
        for frame in frames:
            connection.send(frame)
        for frame in frames:
            reply = decode(connection.recv(timeout=60))
            assert reply["message_type"] == "error", frame[:200]
            code, message = reply["payload"]["code"], reply["payload"]["message"]
            assert code in ("invalid_frame", "unknown_message_type", "infer_failed", "call_failed")
            assert "Traceback" not in message
            assert "File " not in message
            assert len(message) <= 1000
        done += len(frames)
    return done
