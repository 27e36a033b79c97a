"""The policy folder, in the stand-in of RoboTwin's evaluation."""

import json
import shutil
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from deployed import Recaller, looking_act, save, tiny_act
from fake_policy import Reacher
from fake_simulator import FakeSimulator
from folders import files_of
from PIL import Image
from robotwin_environment import TaskEnv, evaluate, import_policy, read_settings

from ugr_lightning.bridges import robotwin_policy as robotwin
from ugr_lightning.bridges.deployment import scaled
from ugr_lightning.bridges.export import export_policy
from ugr_lightning.data.layout import Layout
from ugr_lightning.errors import CheckpointError, ConfigError, NumericsError, ProtocolError
from ugr_lightning.models.checkpoint import sha256
from ugr_lightning.rollout.alarm import Alarm, write_alarms
from ugr_lightning.rollout.evaluate import run_episodes
from ugr_lightning.rollout.spec import RolloutSpec

SIZE = (30, 40)


@pytest.fixture(scope="module")
def reacher(tmp_path_factory):
    return save(Reacher(), tmp_path_factory.mktemp("run") / "policy_best.ckpt")


def settings(file, **more):
    return {"checkpoint": str(file), "execution": "aggregate", "left_arm_dim": 6, "right_arm_dim": 6, **more}


def fake_environment(size=SIZE):
    return TaskEnv(FakeSimulator("reach", image_size=size))


def begun():
    """An environment at the beginning of an episode, and what it shows."""
    environment = fake_environment()
    environment.setup_demo(0)
    return environment, environment.get_obs()


@pytest.mark.parametrize(
    "policy", [Reacher(), Recaller(), tiny_act(), looking_act()], ids=["reacher", "recaller", "act", "keyframes"]
)
def test_every_execution_moves_as_in_our_own_rollout(rolled_out, policy, tmp_path):
    checkpoint, seeds = save(policy, tmp_path / "a.ckpt"), [0, 1, 5, 6]
    for execution in ("aggregate", 1, 4):
        model = robotwin.get_model(settings(checkpoint, execution=execution))
        assert evaluate(robotwin, model, fake_environment(), seeds) == rolled_out(policy, seeds, execution)


def test_a_policy_with_keyframes_refuses_an_environment_without_calibration(tmp_path):
    model = robotwin.get_model(settings(save(looking_act(), tmp_path / "a.ckpt")))
    environment, observation = begun()
    for view in observation["observation"].values():
        view.pop("extrinsic_cv", None)
    with pytest.raises(ProtocolError, match=r"^head_camera/extrinsic_cv: .*\(3, 4\).* got nothing"):
        robotwin.eval(environment, model, observation)


@pytest.mark.renders
def test_our_simulator_driven_through_robotwins_interface_moves_as_in_a_rollout(tmp_path):
    from ugr_lightning.sim.sapien_simulator import SapienSimulator

    policy, seeds = tiny_act(chunk_length=50), [200000, 200001]
    spec = RolloutSpec(
        "click_alarmclock", seeds, image_size=SIZE, execution=50, workers=1, timeout_s=300, progress=False
    )
    results = run_episodes(policy.for_inference(), spec)
    model = robotwin.get_model(settings(save(policy, tmp_path / "a.ckpt"), execution=50))
    with SapienSimulator("click_alarmclock", image_size=SIZE) as simulator:
        outcomes = evaluate(robotwin, model, TaskEnv(simulator), seeds)
    assert outcomes == {result.seed: (result.success, result.steps, result.motion_hash) for result in results}


def test_what_is_left_of_a_chunk_after_success_is_ignored_and_no_action_exceeds_the_limit(reacher):
    model, environment = robotwin.get_model(settings(reacher, execution=5)), fake_environment()
    success, steps, _ = evaluate(robotwin, model, environment, [0])[0]
    assert success
    assert steps % 5 != 0
    assert environment.ignored == 5 - steps % 5
    short = TaskEnv(FakeSimulator("unsolvable", image_size=SIZE), step_lim=7)
    assert evaluate(robotwin, model, short, [0])[0][:2] == (False, 7)


def test_pictures_of_robotwins_size_are_shrunk_as_in_training(tmp_path):
    picture = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    shrunk = scaled(picture, (120, 160))
    assert np.array_equal(shrunk, np.asarray(Image.fromarray(picture).resize((160, 120), Image.Resampling.BOX)))
    areas = picture.reshape(120, 2, 160, 2, 3).mean((1, 3))
    assert np.abs(shrunk - areas).max() <= 1, "each pixel is the mean of its area, rounded once per axis"
    assert scaled(picture, (240, 320)) is picture
    checkpoint = save(Reacher(), tmp_path / "a.ckpt", image_size=(120, 160))
    outcomes = evaluate(robotwin, robotwin.get_model(settings(checkpoint)), fake_environment((240, 320)), [5])
    assert outcomes[5][0]


def test_cameras_are_found_by_name_in_whatever_order_the_policy_wants_them(tmp_path):
    encoded = robotwin.encode_obs(begun()[1])
    cameras = ("cam_left_wrist", "cam_high")
    model = robotwin.get_model(settings(save(Reacher(cameras=cameras), tmp_path / "a.ckpt")))
    seen = model.deployment.see(encoded["images"], encoded["state"])
    assert model.deployment.cameras == {"cam_left_wrist": "left_camera", "cam_high": "head_camera"}
    assert np.array_equal(seen.images[0], encoded["images"]["left_camera"])
    assert np.array_equal(seen.images[1], encoded["images"]["head_camera"])
    renamed = robotwin.get_model(settings(tmp_path / "a.ckpt", cameras={"cam_high": "front_camera"}))
    seen = renamed.deployment.see(encoded["images"], encoded["state"])
    assert np.array_equal(seen.images[1], encoded["images"]["front_camera"])
    overhead = save(Reacher(cameras=("overhead",)), tmp_path / "b.ckpt")
    assert robotwin.get_model(settings(overhead, cameras={"overhead": "head_camera"}))
    with pytest.raises(ConfigError, match="overhead"):
        robotwin.get_model(settings(overhead))


def test_joints_and_cameras_that_the_training_picked_are_not_taken_for_those_of_the_environment(tmp_path):
    swapped = Layout(state=(*range(7, 14), *range(7)))
    picked = save(Reacher(), tmp_path / "a.ckpt", layout=asdict(swapped))
    with pytest.raises(CheckpointError, match=r"`data.layout.state` picked.*`ignore_layout`"):
        robotwin.get_model(settings(picked))
    with pytest.raises(CheckpointError, match="ignore_layout"):
        robotwin.write_policy(picked, tmp_path / "UGR")
    assert robotwin.get_model(settings(picked, ignore_layout="true")), "only the files were in another order"
    robotwin.write_policy(picked, tmp_path / "UGR", ignore_layout=True)
    assert read_settings(tmp_path / "UGR")["ignore_layout"] is True
    front = save(Reacher(), tmp_path / "b.ckpt", layout=asdict(Layout({"cam_high": "front_camera"})))
    with pytest.raises(ConfigError, match=r"cam_high.*usual one is head_camera.*files had front_camera"):
        robotwin.get_model(settings(front))
    for name in ("front_camera", "head_camera"):
        assert robotwin.get_model(settings(front, cameras={"cam_high": name})).deployment.cameras["cam_high"] == name
    known = save(Reacher(), tmp_path / "c.ckpt", layout=asdict(Layout({"cam_high": "cam_head"})))
    assert robotwin.get_model(settings(known)), "another project's word for the same camera"


def test_strings_where_switches_and_numbers_are_meant_are_understood(reacher):
    def execution(**more):
        return robotwin.get_model(settings(reacher, **more)).deployment._actor.execution

    assert execution(temporal_agg="true") == "aggregate"
    assert execution(temporal_agg="false") == "5", "whole chunks, as ACT without aggregation"
    assert execution(temporal_agg=False, execution="3") == "3"
    assert execution(execution="2") == "2"
    assert execution(execution=None, temporal_agg="None") == "aggregate"
    assert execution(execution="chunk") == "5"
    assert robotwin.get_model(settings(reacher, image_size="[24, 32]")).deployment.image_size == (24, 32)
    for wrong in ({"temporal_agg": "maybe"}, {"execution": "sometimes"}, {"execution": 3, "temporal_agg": "true"}):
        with pytest.raises(ConfigError):
            execution(**wrong)
    for wrong in ({"image_size": "large"}, {"refine_ratio": "much"}, {"device": "abacus"}, {"checkpoint": None}):
        with pytest.raises(ConfigError):
            robotwin.get_model(settings(reacher, **wrong))


def test_checkpoints_that_cannot_be_evaluated_are_refused(tmp_path):
    unfitted = save(tiny_act(fitted=False), tmp_path / "unfitted.ckpt")
    with pytest.raises(CheckpointError, match="statistics"):
        robotwin.get_model(settings(unfitted))
    with pytest.raises(CheckpointError, match="size of the pictures"):
        robotwin.get_model(settings(save(Reacher(), tmp_path / "sizeless.ckpt", image_size=None)))
    with pytest.raises(CheckpointError, match="commanded"):
        robotwin.get_model(settings(save(Reacher(), tmp_path / "measured.ckpt", state="measured")))
    with pytest.raises(CheckpointError, match="14 joints"):
        robotwin.get_model(settings(save(Reacher(), tmp_path / "arms.ckpt"), left_arm_dim=7, right_arm_dim=7))


def test_observations_of_another_form_are_refused_by_name(reacher):
    (environment, _), model = begun(), robotwin.get_model(settings(reacher))
    for spoil, complaint in (
        (lambda o: o["observation"].pop("left_camera"), "left_camera"),
        (lambda o: o["observation"]["head_camera"].update(rgb=np.zeros((4, 4))), "head_camera"),
        (lambda o: o["joint_action"].update(vector=np.zeros(16)), "14 numbers"),
        (lambda o: o["joint_action"].update(vector=np.full(14, np.nan)), "finite"),
        (lambda o: o["joint_action"].pop("vector"), "joint_action/vector"),
    ):
        observation = environment.get_obs()
        spoil(observation)
        with pytest.raises(ProtocolError, match=complaint):
            robotwin.eval(environment, model, observation)
    assert environment.take_action_cnt == 0


def test_a_command_that_is_not_finite_never_reaches_the_robot(tmp_path):
    model = robotwin.get_model(settings(save(Reacher(broken=0.1), tmp_path / "a.ckpt")))
    environment, observation = begun()
    with pytest.raises(NumericsError, match="at \\[0\\]"):
        robotwin.eval(environment, model, observation)
    assert environment.take_action_cnt == 0


def test_the_folder_is_imported_by_its_name_and_acts_like_the_package(
    rolled_out, reacher, tmp_path, monkeypatch, capsys
):
    folder = tmp_path / "policy" / "UGR"
    written = robotwin.write_policy(reacher, folder, execution=3, copy=True)
    assert {path.name for path in written} == {path.name for path in folder.iterdir()}
    shutil.move(folder.parent, tmp_path / "elsewhere")  # a copied checkpoint travels with it
    folder = tmp_path / "elsewhere" / "UGR"
    package = import_policy(folder, monkeypatch)
    model = package.get_model(read_settings(folder, "--task_name", "reach", "--temporal_agg", "false"))
    assert "execution 3" in capsys.readouterr().out
    assert evaluate(package, model, fake_environment(), [0, 5]) == rolled_out(Reacher(), [0, 5], 3)
    model = package.get_model(read_settings(folder, "--execution", "aggregate", "--temporal_agg", "true"))
    assert evaluate(package, model, fake_environment(), [0, 5]) == rolled_out(Reacher(), [0, 5], "aggregate")


def test_an_alarm_is_logged_once_an_episode_and_travels_with_a_copied_checkpoint(reacher, tmp_path, caplog):
    file = tmp_path / "policy_best.ckpt"
    shutil.copy(reacher, file)
    folder = tmp_path / "policy" / "UGR"
    write_alarms(file, [Alarm(sha256(file), "2", "reach", "demo_clean", "hash", 40, 0.1, threshold=9.0, steps=3)])
    robotwin.write_policy(file, folder, execution=2, copy=True)
    model = robotwin.get_model(settings(folder / file.name, execution=2))
    silent = robotwin.get_model(settings(reacher, execution=2))
    assert evaluate(robotwin, model, fake_environment(), [0, 5]) == evaluate(
        robotwin, silent, fake_environment(), [0, 5]
    )
    assert [record.message for record in caplog.records if record.levelname == "WARNING"] == [
        "alarm in environment 0 at step 4 of its episode"
    ] * 2
    assert (model.deployment.alarms, silent.deployment.alarms) == ({0: 4}, {})
    model.reset_model()
    environment, observation = begun()
    robotwin.eval(environment, model, observation)
    assert model.deployment.alarms == {}
    robotwin.write_policy(folder / file.name, folder, execution=2, copy=True)
    assert (folder / "policy_best.alarm.json").exists(), "copied onto itself it stays as it is"
    robotwin.write_policy(reacher, folder, execution=2, copy=True)
    assert not (folder / "policy_best.alarm.json").exists(), "one without an alarm takes the place of one with it"


def test_an_exported_folder_is_a_checkpoint_too_and_can_be_copied(tmp_path, monkeypatch):
    exported, folder = tmp_path / "exported", tmp_path / "policy" / "UGR"
    export_policy(save(tiny_act(), tmp_path / "a.ckpt"), "safetensors", exported)
    for _ in range(2):  # the second replaces the first
        robotwin.write_policy(exported, folder, execution=5, copy=True)
    shutil.rmtree(exported)
    package = import_policy(folder, monkeypatch)
    same = robotwin.get_model(settings(tmp_path / "a.ckpt", execution=5))
    outcomes = [
        evaluate(robotwin, model, fake_environment(), [0]) for model in (same, package.get_model(read_settings(folder)))
    ]
    assert outcomes[0] == outcomes[1]


def test_the_scripts_say_how_to_call_them_and_start_robotwins_evaluation_with_its_overrides(reacher, tmp_path):
    folder = tmp_path / "policy" / "UGR"
    robotwin.write_policy(reacher, folder)
    for script in folder.glob("*.sh"):
        assert subprocess.run(["bash", "-n", script], check=False).returncode == 0
        called = subprocess.run(["bash", script], capture_output=True, text=True, check=False)
        assert called.returncode == 2
        assert script.name in called.stderr
    (tmp_path / "script").mkdir()
    (tmp_path / "script" / "eval_policy.py").write_text("import json, sys; print(json.dumps(sys.argv[1:]))")
    path = {"PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin"}
    command = ["bash", folder / "eval.sh", "click_alarmclock", "demo_clean", "first", "0", "0", "--execution", "25"]
    called = subprocess.run(command, capture_output=True, text=True, check=True, env=path)
    given = json.loads(called.stdout)
    assert given[:2] == ["--config", "policy/UGR/deploy_policy.yml"]
    overrides = dict(zip(given[3::2], given[4::2], strict=True))
    assert overrides["--task_name"] == "click_alarmclock"
    assert overrides["--policy_name"] == "UGR"
    assert overrides["--execution"] == "25"


class Client:
    """RoboTwin's client for a model in another process: methods by name, everything through JSON and back."""

    def __init__(self, model):
        self.model, self.calls = model, []

    def call(self, func_name=None, obs=None):
        self.calls.append(func_name)
        method = getattr(self.model, func_name)
        answer = method(self.through_json(obs)) if obs is not None else method()
        return self.through_json(answer)

    def through_json(self, value):
        def pack(array):
            return {"array": array.tobytes().hex(), "dtype": str(array.dtype), "shape": array.shape}

        def unpack(found):
            if "array" not in found:
                return found
            return np.frombuffer(bytes.fromhex(found["array"]), found["dtype"]).reshape(found["shape"])

        return json.loads(json.dumps(value, default=pack), object_hook=unpack)


@pytest.mark.parametrize("policy", [Reacher(), looking_act()], ids=["reacher", "keyframes"])
def test_with_two_environments_robotwins_side_needs_no_package_of_ours(rolled_out, policy, tmp_path, monkeypatch):
    checkpoint, folder = save(policy, tmp_path / "a.ckpt"), tmp_path / "policy" / "UGR"
    robotwin.write_policy(checkpoint, folder)
    client = Client(robotwin.get_model(settings(checkpoint)))
    expected = rolled_out(policy, [0, 5], "aggregate")

    class Here:
        eval, reset_model = robotwin.eval, staticmethod(lambda model: model.call("reset_model"))

    assert evaluate(Here, client, fake_environment(), [0, 5]) == expected, "with the package"
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    bare = import_policy(folder, monkeypatch)
    assert evaluate(bare, client, fake_environment(), [0, 5]) == expected, "without"
    assert bare.eval.__module__ == "UGR.deploy_policy_double_env"
    with pytest.raises(SystemExit, match=r"eval_double_env\.sh"):
        bare.get_model({})


def test_a_folder_of_somebody_else_is_left_alone(reacher, tmp_path):
    folder = tmp_path / "UGR"
    folder.mkdir()
    (folder / "eval.sh").write_text("echo mine")
    with pytest.raises(ConfigError, match=r"eval\.sh"):
        robotwin.write_policy(reacher, folder)
    assert [path.name for path in folder.iterdir()] == ["eval.sh"]
    assert (folder / "eval.sh").read_text() == "echo mine"
    (folder / "eval.sh").unlink()
    robotwin.write_policy(reacher, folder)
    robotwin.write_policy(reacher, folder, execution=2)
    assert read_settings(folder)["execution"] == 2
    with pytest.raises(ConfigError, match="Python module"):
        robotwin.write_policy(reacher, tmp_path / "my-policy")


def test_what_was_edited_is_not_written_over(reacher, tmp_path):
    folder = tmp_path / "UGR"
    robotwin.write_policy(reacher, folder, execution=2)
    for name in ("deploy_policy.yml", "README.md"):
        whole = (folder / name).read_text()
        (folder / name).write_text(whole.replace("policy", "Policy"))
        before = files_of(folder)
        with pytest.raises(ConfigError, match=rf"{name}: .* edited since, .*\. Move it away"):
            robotwin.write_policy(reacher, folder, execution=3)
        assert files_of(folder) == before
        (folder / name).write_text(whole)
    robotwin.write_policy(reacher, folder, execution=3)
    assert read_settings(folder)["execution"] == 3
