import io
import json
from contextlib import nullcontext

import numpy as np
import pytest
from lightning.pytorch import Callback
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny import TinyPolicy, train

from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import ConfigError, RenderError
from ugr_lightning.results.results import EpisodeResult
from ugr_lightning.rollout.simulators import Simulators
from ugr_lightning.rollout.trajectory import EpisodeTrace
from ugr_lightning.sim.registry import TaskRobot
from ugr_lightning.training.callbacks import rollout_evaluation as rollout
from ugr_lightning.training.callbacks.rollout_evaluation import RolloutEvaluation


def lend_robot(monkeypatch, joints):
    """All tasks have a robot of so many joints."""
    robot = TaskRobot(CAMERAS, joints, 25.0)
    for module in ("rollout.evaluate", "training.callbacks.rollout_evaluation"):
        monkeypatch.setattr(f"ugr_lightning.{module}.robot_of", lambda task: robot)


@pytest.fixture
def world(monkeypatch):
    """Rollouts without a simulator: even seeds succeed. Returns the calls."""
    calls = []

    def run_episodes(actor, spec, *, simulators, on_result):
        calls.append(vars(spec) | {"training": actor.policy.training, "simulators": simulators})
        results = []
        for seed in spec.seeds:
            success = seed % 2 == 0
            result = EpisodeResult(spec.task, "demo_clean", seed, "hash", actor.name, None, "aggregate", success, 10)
            if seed in spec.videos:
                result.video = str(spec.videos[seed])
                frames = [Image.new("RGB", (8, 6), color) for color in ("red", "green")]
                frames[0].save(result.video, save_all=True, append_images=frames[1:])
            on_result(result, EpisodeTrace(log_variance=[np.zeros(5), None, np.ones(5)]))
            results.append(result)
        return results

    monkeypatch.setattr(rollout, "run_episodes", run_episodes)
    monkeypatch.setattr("ugr_lightning.sim.render.require_rendering", lambda task: None)
    lend_robot(monkeypatch, 3)
    return calls


def test_rollouts_use_selection_seeds_and_log_rate_interval_video_and_uncertainty(tmp_path, world):
    folder = tmp_path / "tiny" / "version_0"
    trainer = train(folder, callbacks=[RolloutEvaluation(every_n_steps=5, episodes=3)], max_steps=10)
    assert [call["seeds"] for call in world] == [[200000, 200001, 200002]] * 2
    assert world[0]["task"] == "click_alarmclock"
    assert world[0]["image_size"] == (4, 4)
    assert float(trainer.callback_metrics["rollout/success_rate"]) == pytest.approx(2 / 3)
    assert (
        0 < trainer.callback_metrics["rollout/success_low"] < 2 / 3 < trainer.callback_metrics["rollout/success_high"]
    )
    lines = (folder / "rollouts" / "step0000005.jsonl").read_text().splitlines()
    assert [json.loads(line)["success"] for line in lines] == [True, False, True]
    events = EventAccumulator(str(folder), size_guidance={"images": 0}).Reload()
    assert "rollout/uncertainty" in events.Tags()["images"]
    gif = events.Images("rollout/episode")[0].encoded_image_string
    assert Image.open(io.BytesIO(gif)).n_frames == 2
    assert "rollout/success_rate" in events.Tags()["scalars"]


@pytest.mark.parametrize("fault", [None, ValueError("a fault in training")])
def test_simulators_stay_for_the_whole_training_and_end_with_it(tmp_path, world, monkeypatch, fault):
    class Late(Callback):
        def on_train_batch_end(self, trainer, *_):
            if fault is not None and trainer.global_step == 4:
                raise fault

    closed = []
    monkeypatch.setattr(Simulators, "close", lambda opened: closed.append((opened, len(world))))
    callback = RolloutEvaluation(every_n_steps=1, episodes=1)
    with nullcontext() if fault is None else pytest.raises(ValueError, match="a fault"):
        train(tmp_path / "tiny" / "version_0", callbacks=[callback, Late()], max_steps=5)
    kept = {call["simulators"] for call in world}
    assert len(kept) == 1
    assert (kept.pop(), len(world)) == closed[-1]


def test_rollouts_do_not_change_the_training(tmp_path, world):
    losses = []
    for name, every in (("a", 0), ("b", 1)):
        folder = tmp_path / name / "version_0"
        trainer = train(folder, callbacks=[RolloutEvaluation(every_n_steps=every, episodes=1)], max_steps=10)
        losses.append(float(trainer.callback_metrics["train/loss"]))
    assert losses[0] == losses[1]


def no_renderer(task):
    raise RenderError("rendering", "a Vulkan device", "none", "Install mesa-vulkan-drivers.")


def test_training_goes_on_with_one_warning_where_nothing_can_render(tmp_path, world, monkeypatch):
    monkeypatch.setattr("ugr_lightning.sim.render.require_rendering", no_renderer)
    callback = RolloutEvaluation(every_n_steps=1, episodes=1)
    with pytest.warns(UserWarning, match="without rollouts.*mesa-vulkan-drivers"):
        trainer = train(tmp_path / "tiny" / "version_0", callbacks=[callback], max_steps=5)
    assert trainer.global_step == 5
    assert world == []


@pytest.mark.parametrize("what", ["joints", "cameras"])
def test_a_policy_of_another_robot_is_refused_before_the_first_step(what, tmp_path, world, monkeypatch):
    if what == "joints":
        lend_robot(monkeypatch, 14)
    policy = TinyPolicy(cameras=("top" if what == "cameras" else "cam_high",))
    policy.losses = lambda batch: pytest.fail("trained")
    with pytest.raises(ConfigError, match=r"robot of click_alarmclock.*rollout\.every_n_steps to 0"):
        train(tmp_path / "tiny" / "version_0", policy, [RolloutEvaluation(every_n_steps=1)], max_steps=5)
    assert world == []


@pytest.mark.parametrize("first", [True, False])
def test_every_process_asks_where_the_run_is_because_the_first_one_waits_for_them(tmp_path, monkeypatch, first):
    asked, evaluated = [], []

    class Process:
        global_step, is_global_zero = 4, first

        @property
        def log_dir(self):
            asked.append(True)
            return str(tmp_path)

    callback = RolloutEvaluation(every_n_steps=2)
    monkeypatch.setattr(callback, "_evaluate", lambda *given: evaluated.append(given[-1]))
    callback.on_train_batch_end(Process(), None)
    assert asked == [True]
    assert evaluated == [tmp_path] * first
