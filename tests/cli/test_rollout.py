import json
import signal
from pathlib import Path

import pytest
import torch
from PIL import Image

from ugr_lightning.cli.main import main
from ugr_lightning.data.layout import Layout
from ugr_lightning.errors import ConfigError
from ugr_lightning.models.checkpoint import load_policy
from ugr_lightning.results.results import read_results
from ugr_lightning.sim.seeds import seed_list
from ugr_lightning.system.signals import Stopped


def test_rollout_prints_rate_and_interval_and_writes_a_line_per_episode(world, tmp_path, capsys):
    out = tmp_path / "results.jsonl"
    command = "rollout --policy zero --task click_alarmclock --seeds 300000 --episodes 4 --execution 25 --out".split()
    assert main([*command, str(out)]) == 0
    said = capsys.readouterr().out
    assert "2/4" in said
    assert "[15.0%, 85.0%]" in said
    assert [json.loads(line)["seed"] for line in out.read_text().splitlines()] == [300000, 300001, 300002, 300003]
    assert world[0]["execution"] == 25


@pytest.mark.parametrize("command", ["rollout", "test"])
def test_episodes_that_all_crash_are_no_result(world, checkpoint, tmp_path, capsys, command):
    world.crash, out = "the command is not finite", str(tmp_path / "r.jsonl")
    assert main([command, str(checkpoint), "--episodes", "2", "--out", out]) == 2
    said = capsys.readouterr()
    assert "0/2 = 0.0%" in said.out
    assert "that crashed, the first with: the command is not finite" in said.err


def test_only_a_video_means_one_episode(world, tmp_path):
    gif = tmp_path / "out.gif"
    assert main(["rollout", "--policy", "expert", "--task", "handover_block", "--video", str(gif)]) == 0
    assert Image.open(gif).format == "GIF"
    assert len(world[0]["seeds"]) == 1


def test_a_policy_that_is_neither_a_name_nor_a_file_is_explained(world, capsys):
    assert main(["rollout", "--policy", "exprt", "--task", "click_alarmclock"]) == 2
    assert "expert" in capsys.readouterr().err


def test_test_rolls_out_the_best_checkpoint_in_both_modes_on_the_evaluation_seeds(world, tiny_config, capsys):
    assert main(["fit", "--config", tiny_config]) == 0
    assert main(["test", "--episodes", "3"]) == 0
    assert "policy_best.ckpt" in capsys.readouterr().out
    assert [call["execution"] for call in world] == ["aggregate", 5]
    assert all(call["seeds"][0] >= 100000 and call["image_size"] == (8, 12) for call in world)
    assert world[0]["checkpoint"] is not None
    assert world[0]["simulators"] is world[1]["simulators"] is not None, "both modes run in the same simulators"
    assert len(Path("runs/tiny/version_0/evaluation.jsonl").read_text().splitlines()) == 6


def test_a_run_alone_means_its_best_checkpoint_and_not_the_expert(world, checkpoint, capsys):
    command = ["rollout", "--run", str(checkpoint.parent), "--episodes", "1"]
    assert main(command) == 0
    assert world[0]["checkpoint"] is not None
    assert main([*command, "--policy", "zero"]) == 2
    assert "not both" in capsys.readouterr().err


def test_each_checkpoint_of_a_run_has_results_of_its_own_that_can_be_reported(
    world, checkpoint, ten_demonstrations, capsys
):
    assert main(["refine", str(checkpoint), "--data", str(ten_demonstrations)]) == 0
    refined = checkpoint.with_name("policy_best_refined.ckpt")
    few = ["--episodes", "2", "--executions", "[aggregate]"]
    for file, results in ((checkpoint, "evaluation.jsonl"), (refined, "evaluation-policy_best_refined.jsonl")):
        capsys.readouterr()
        assert main(["test", str(file), *few]) == 0
        assert f"episodes: {file.with_name(results)}" in capsys.readouterr().out
        assert main(["report", "--runs", f"a={file.with_name(results)}"]) == 0
    assert main(["export", str(refined), "--to", "safetensors", "--out", str(checkpoint.with_name("out"))]) == 0
    assert "1/2 = 50.0%" in (checkpoint.with_name("out") / "README.md").read_text()
    assert main(["test", str(checkpoint.with_name("out")), *few]) == 0
    assert (checkpoint.with_name("out") / "evaluation.jsonl").is_file()


def test_a_checkpoint_is_loaded_once_for_all_executions(world, checkpoint, monkeypatch):
    loaded = []
    monkeypatch.setattr(
        "ugr_lightning.models.checkpoint.load_policy", lambda path: loaded.append(path) or load_policy(path)
    )
    executions = ["--executions", "[aggregate,5,10]", "--episodes", "1"]
    assert main(["test", str(checkpoint), *executions]) == 0
    assert len(world) == 3
    assert main(["sweep", str(checkpoint), "--data", "null", "--ratios", "[0.5]", *executions]) == 0
    assert len(loaded) == 2


def test_the_rate_of_the_data_is_in_the_checkpoint_and_compared_with_the_simulators(world, checkpoint, recwarn):
    content = torch.load(checkpoint)
    assert content["policy"]["data"]["control_hz"] == 25.0
    command = ["rollout", str(checkpoint), "--episodes", "1"]
    assert main(command) == 0
    assert not [warning for warning in recwarn if "actions a second" in str(warning.message)]
    content["policy"]["data"]["control_hz"] = 50.0
    torch.save(content, checkpoint)
    with pytest.warns(UserWarning, match="trained on 50 actions a second"):
        assert main(command) == 0


def test_a_budget_for_a_dummy_is_refused(world, capsys):
    assert main(["rollout", "--policy", "zero", "--task", "click_alarmclock", "--refine_ratio", "0.5"]) == 2
    assert "--refine_ratio" in capsys.readouterr().err


@pytest.mark.parametrize(("chunk_length", "executed"), [(50, 25), (6, 6)])
def test_what_a_test_executes_of_each_chunk_fits_the_checkpoint(
    world, chunk_length, executed, tiny_act, untrained, tmp_path
):
    checkpoint = untrained(tiny_act(None, chunk_length), tmp_path)
    assert main(["test", str(checkpoint), "--episodes", "1"]) == 0
    assert [call["execution"] for call in world] == ["aggregate", executed]


def test_results_say_which_budget_was_chosen_and_a_test_that_goes_on_keeps_budgets_apart(world, checkpoint):
    command = ["test", str(checkpoint), "--episodes", "2", "--executions", "[aggregate]", "--resume"]
    for more in ([], ["--refine_ratio", "0"], ["--refine_ratio", "0.5"], ["--refine_ratio", "0.5"]):
        assert main([*command, *more]) == 0
    assert len(world) == 3, "the last had nothing left to do"
    written = read_results(checkpoint.with_name("evaluation.jsonl"))
    assert [item.refine_ratio for item in written] == [None, None, 0.0, 0.0, 0.5, 0.5]
    assert len({item.policy for item in written}) == 3


def test_the_policy_computes_where_it_is_asked_to(world, checkpoint, monkeypatch, capsys):
    moved, real = [], torch.nn.Module.to
    monkeypatch.setattr(torch.nn.Module, "to", lambda self, place: moved.append(place) or real(self, place))
    for choice in ("auto", "cpu"):
        command = ["--episodes", "1", "--executions", "[aggregate]", "--device", choice]
        assert main(["test", str(checkpoint), *command]) == 0
        assert main(["rollout", str(checkpoint), "--episodes", "1", "--device", choice]) == 0
    here = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    assert moved == [here, here, torch.device("cpu"), torch.device("cpu")]
    assert main(["test", str(checkpoint), "--device", "abacus"]) == 2
    assert "device: expected a device of this machine, got abacus" in " ".join(capsys.readouterr().err.split())


def test_seed_lists_are_what_they_say():
    evaluation, whole = seed_list("evaluation", "click_alarmclock", 5)
    assert evaluation == whole[:5]
    assert len(whole) == 100
    assert seed_list("selection", "click_alarmclock", 2)[0] == [200000, 200001]
    assert seed_list(7, "click_alarmclock", 2)[0] == [7, 8]
    with pytest.raises(ConfigError, match="at most the 100"):
        seed_list("evaluation", "click_alarmclock", 101)


def test_a_test_that_goes_on_runs_only_the_missing_episodes(world, tiny_config, capsys):
    out = Path("results.jsonl")
    assert main(["fit", "--config", tiny_config]) == 0
    assert main(["test", "--episodes", "3", "--executions", "[5]", "--out", str(out)]) == 0
    assert (
        main(["rollout", "--policy", "zero", "--task", "click_alarmclock", "--episodes", "9", "--out", str(out)]) == 0
    )
    with out.open("a") as file:
        file.write('{"task": "click_al')  # a crash
    world.clear()
    assert main(["test", "--episodes", "5", "--out", str(out), "--resume", "--workers", "4"]) == 0
    evaluation, _ = seed_list("evaluation", "click_alarmclock", 5)
    assert [(call["execution"], call["seeds"], call["workers"]) for call in world] == [
        ("aggregate", evaluation, 4),
        (5, evaluation[3:], 4),
    ], "as many workers as without interruption: the size of the policy's batch is part of its arithmetic"
    world.clear()
    capsys.readouterr()
    assert main(["test", "--episodes", "5", "--out", str(out), "--resume"]) == 0
    assert world == []
    assert "/5" in capsys.readouterr().out


def test_a_rollout_that_goes_on_runs_only_the_missing_episodes_of_a_file_that_it_is_told(world, tmp_path, capsys):
    out = tmp_path / "results.jsonl"
    command = ["rollout", "--policy", "zero", "--task", "click_alarmclock", "--seeds", "selection"]
    assert main([*command, "--episodes", "2", "--out", str(out)]) == 0
    assert main([*command, "--episodes", "3", "--out", str(out), "--resume"]) == 0
    assert [call["seeds"] for call in world] == [[200000, 200001], [200002]]
    assert [result.seed for result in read_results(out)] == [200000, 200001, 200002]
    capsys.readouterr()
    assert main([*command, "--episodes", "3", "--resume"]) == 2
    assert "--resume: expected the results file of the start before" in " ".join(capsys.readouterr().err.split())


def test_rollout_hands_the_setting_on_and_clean_is_the_default(world):
    command = ["rollout", "--policy", "zero", "--task", "click_alarmclock", "--episodes", "1"]
    assert main([*command, "--setting", "demo_randomized"]) == 0
    assert main(command) == 0
    assert [call["setting"] for call in world] == ["demo_randomized", "demo_clean"]


@pytest.mark.parametrize("command", ["rollout --seeds evaluation", "test --executions [5]"])
def test_shards_share_a_file_and_one_that_is_started_again_doubles_nothing(
    world, checkpoint, tmp_path, capsys, command
):
    whole = tmp_path / "whole.jsonl"
    name, *options = command.split()
    words = [name, str(checkpoint), *options, "--episodes", "7", "--out"]
    assert main([*words, str(whole)]) == 0
    world.clear()
    for shard in ("2/3", "1/3", "2/3"):
        assert main([*words, str(tmp_path / "parts.jsonl"), "--shard", shard]) == 0
    seeds, _ = seed_list("evaluation", "click_alarmclock", 7)
    assert [call["seeds"] for call in world] == [seeds[1::3], seeds[::3]]
    capsys.readouterr()
    assert main([*words, str(tmp_path / "parts.jsonl"), "--shard", "1/1"]) == 0
    assert world[-1]["seeds"] == seeds[2::3], "a shard that never came"
    assert "/7 = " in capsys.readouterr().out
    found = sorted(read_results(tmp_path / "parts.jsonl"), key=lambda result: result.seed)
    assert found == read_results(whole)


def test_shards_of_who_has_no_chunks_double_nothing_either(world, tmp_path):
    out = tmp_path / "zero.jsonl"
    words = ["rollout", "--policy", "zero", "--task", "click_alarmclock", "--episodes", "4", "--out", str(out)]
    for shard in ("2/2", "1/2", "2/2", "1/1"):
        assert main([*words, "--shard", shard]) == 0
    assert [len(call["seeds"]) for call in world] == [2, 2]


def test_one_shard_films_the_first_episode_and_no_other_writes_over_it(world, tmp_path, capsys):
    video, out = tmp_path / "v.gif", tmp_path / "r.jsonl"
    words = ["rollout", "--policy", "zero", "--task", "click_alarmclock", "--episodes", "4", "--out", str(out)]
    for shard in ("1/2", "2/2", "1/1"):
        assert main([*words, "--video", str(video), "--shard", shard]) == 0
    assert [set(call["videos"]) & set(call["seeds"]) for call in world] == [{world[0]["seeds"][0]}, set()]
    assert capsys.readouterr().out.count(f"video: {video}") == 2, "the shard that has it, and the whole"
    assert main([*words, "--shard", "1/1", "--video", str(tmp_path / "late.gif")]) == 0
    assert f"video: {video}" in capsys.readouterr().out, "where the film of this episode is"


@pytest.mark.parametrize("command", ["rollout", "test"])
def test_a_shard_too_many_has_nothing_to_do(world, tiny_act, untrained, tmp_path, capsys, command):
    checkpoint = untrained(tiny_act(), tmp_path)
    assert main([command, str(checkpoint), "--episodes", "4", "--out", str(tmp_path / "r"), "--shard", "5/8"]) == 0
    assert "nothing to do for shard 5/8 of 4 episodes" in capsys.readouterr().out
    assert world == []


def test_shards_of_a_rollout_need_a_file_that_they_share(world, capsys):
    assert main(["rollout", "--policy", "zero", "--task", "click_alarmclock", "--shard", "1/2"]) == 2
    assert "--out FILE" in capsys.readouterr().err
    assert world == []


def test_a_rollout_on_other_pictures_or_on_the_scenes_of_the_training_says_so(world, checkpoint, recwarn, capsys):
    command = ["rollout", str(checkpoint), "--episodes", "1"]
    assert main(command) == 0
    assert main(["rollout", "--task", "click_alarmclock", "--episodes", "1", "--seeds", "3"]) == 0
    assert not list(recwarn), "the expert was shown nothing"
    with pytest.warns(UserWarning, match="trained on pictures of .*, not 60x80"):
        assert main([*command, "--image_size", "[60, 80]"]) == 0
    with pytest.warns(UserWarning, match="Seeds below 100000 are those of demonstrations"):
        assert main([*command, "--seeds", "3"]) == 0
    world.clear()
    assert main([*command, "--seeds", "-5"]) == 2
    assert "--seeds: expected a first seed of 0 or more" in " ".join(capsys.readouterr().err.split())
    assert world == []


def test_an_interrupted_test_says_how_the_other_episodes_are_run(world, checkpoint, monkeypatch, capsys):
    def stopped(*arguments, **options):
        raise Stopped(signal.SIGTERM)

    monkeypatch.setattr("ugr_lightning.rollout.evaluate.run_episodes", stopped)
    assert main(["test", str(checkpoint)]) == 143
    assert "interrupted by SIGTERM (`--resume` runs the other episodes)" in capsys.readouterr().err
    assert main(["rollout", str(checkpoint)]) == 143
    assert capsys.readouterr().err.strip().endswith("interrupted by SIGTERM"), "no file that could go on"


def test_joints_that_the_training_picked_are_not_silently_taken_for_those_of_the_simulator(
    world, untrained, ten_demonstrations, tiny_act, tmp_path
):
    place = ten_demonstrations / "click_alarmclock" / "demo_clean"
    swapped = Layout(state=(*range(7, 14), *range(7)))
    checkpoint = untrained(tiny_act(), tmp_path, {"folder": str(place), "layout": swapped})
    with pytest.warns(UserWarning, match=r"`data.layout` picked.*robot of click_alarmclock, success says little"):
        assert main(["test", str(checkpoint), "--episodes", "1", "--executions", "[aggregate]"]) == 0
