"""The same rooms joined with the real simulator, on tiny pictures."""

from functools import partial

import numpy as np

from ugr_lightning.data.formats.robotwin import read_episode
from ugr_lightning.data.storage.jpeg import decode_jpeg, encode_frame
from ugr_lightning.demos import recorder
from ugr_lightning.demos.noise import Noise
from ugr_lightning.rollout.actors import Actor, Decision
from ugr_lightning.rollout.evaluate import run_episodes
from ugr_lightning.rollout.spec import RolloutSpec
from ugr_lightning.sim.registry import open_simulator

TASK, SIZE, SEED = "click_alarmclock", (30, 40), 0
MEAN_JPEG_ERROR = 3
"""Grey levels, at quality 95 with halved colour resolution; single pixels at edges of tiny pictures are far off."""


class Witness(Actor):
    """Holds still and remembers the first frame of each seed."""

    name = "witness"
    cameras = ("cam_high",)

    def __init__(self):
        self.first = {}

    def start(self, slot, seed, frame):
        self.first[seed] = frame

    def act(self, frames):
        return {slot: Decision(None) for slot in frames}


def test_a_policy_first_sees_what_a_demonstration_first_showed(tmp_path, monkeypatch):
    pictures = []

    def watch(images):
        pictures.append(images.copy())
        return encode_frame(images)

    monkeypatch.setattr(recorder, "encode_frame", watch)
    open_task = partial(open_simulator, TASK, image_size=SIZE)
    assert recorder.Recorder(open_task, Noise(), tmp_path).record(SEED).failure is None
    demonstration = read_episode(recorder.staged_episode(tmp_path, SEED))
    witness = Witness()
    spec = RolloutSpec(TASK, [7, SEED], image_size=SIZE, workers=1, timeout_s=300, progress=False)
    results = run_episodes(witness, spec)  # after another episode, and in the second slot
    assert all(result.success for result in results)
    seen = witness.first[SEED]
    recorded = demonstration.images(0)  # (V, H, W, 3)
    through_codec = np.empty_like(seen.images)
    for picture, jpeg in zip(through_codec, encode_frame(seen.images), strict=True):
        decode_jpeg(jpeg, picture)
    assert demonstration.seed == SEED
    assert np.array_equal(recorded, through_codec)
    assert np.abs(recorded.astype(int) - seen.images).mean() < MEAN_JPEG_ERROR
    assert np.array_equal(demonstration.state[0], seen.commanded)
    assert np.array_equal(pictures[0], seen.images), "before encoding they are the same bit for bit"
