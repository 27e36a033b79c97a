"""`ugr analyze` from a checkpoint to its tables and figures."""

import json

import numpy as np
import pytest
from PIL import Image
from tiny import TinyPolicy

from ugr_lightning.cli.main import main
from ugr_lightning.data.layout import Joint, Layout
from ugr_lightning.data.split import Split
from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.models.checkpoint import load_policy, sha256


@pytest.fixture
def command(ten_demonstrations, tmp_path, untrained):
    """The command line for a checkpoint of a policy that was told the statistics and learned nothing."""
    untrained(TinyPolicy(cameras=CAMERAS, dim=14), tmp_path)
    return ["analyze", str(tmp_path / "policy_best.ckpt"), "--data", str(ten_demonstrations), "--resamples", "20"]


def test_analyze_writes_numbers_tables_and_figures_and_says_one_sentence(command, capsys, tmp_path):
    assert main(command) == 0
    said = capsys.readouterr().out
    folder = tmp_path / "analysis-policy_best"
    found = json.loads((folder / "analysis.json").read_text())
    assert found["verdict"] in said
    assert "On 2 validation episodes s_k " in found["verdict"]
    assert found["validation"] == {"episodes": 2, "chunks": 6}  # 12 steps, every fifth
    assert len(found["position"]["training_error"]) == 5
    assert found["verdict"] in (folder / "analysis.md").read_text()
    assert {row["name"] for row in found["statistics"]} >= {"AUSE", "NLL, nats", "Spearman within position"}
    assert {"close", "open"} <= set(found["events"])  # the made-up grippers move at random
    for name in ("calibration", "events"):
        assert np.asarray(Image.open(folder / f"{name}.png")).std() > 0
    assert not list(folder.glob("*.partial"))
    assert main([*command, "--estimators", "--stride", "2"]) == 0
    assert "overlapping chunks" in capsys.readouterr().out
    assert main([*command, "--estimators"]) == 2
    assert "expected chunks of 5 steps that overlap, got one every 5 steps" in capsys.readouterr().err


def test_data_with_a_folder_and_a_layout_of_their_own_are_found_again(ten_demonstrations, tmp_path, untrained):
    place = ten_demonstrations / "click_alarmclock" / "demo_clean"
    joints = (Joint(6, closed=0.0, open=2.0), 0, "right_joint_1")
    chosen = {"folder": str(place), "layout": Layout(state=joints)}
    untrained(TinyPolicy(cameras=CAMERAS, dim=3), tmp_path, chosen)
    _, info = load_policy(tmp_path / "policy_best.ckpt")
    assert Layout.of_training(info.data) == Layout(state=joints)
    command = ["analyze", str(tmp_path / "policy_best.ckpt"), "--resamples", "5", "--data"]
    assert main([*command, str(place)]) == 0
    assert "do not tell of these events: close, open" in (tmp_path / "analysis-policy_best/analysis.md").read_text()
    assert main([*command, str(ten_demonstrations)]) == 2, "not a folder of demonstrations"


def test_analyze_refuses_other_episodes_than_those_of_the_split(command, ten_demonstrations, capsys):
    data = ten_demonstrations / "click_alarmclock" / "demo_clean" / "data"
    (data / "episode9.hdf5").rename(data / "episode10.hdf5")
    assert main(command) == 2
    assert "split" in capsys.readouterr().err


def test_failures_are_told_from_traces_of_this_checkpoint_alone(command, capsys, tmp_path):
    assert main([*command, "--traces", str(tmp_path)]) == 2
    assert "traces of this checkpoint" in capsys.readouterr().err
    sha = sha256(tmp_path / "policy_best.ckpt")[:8]
    for seed in range(30):
        success, query = seed < 20, np.arange(40)
        arrays = {"seed": seed, "success": success, "steps": 40, "query": query, "contacts": np.zeros((41, 2), bool)}
        scores = np.full((40, 5), 0.01 * seed if success else 1.0)
        arrays["chunks"] = np.full((40, 5, 14), 0.1) * query[:, None, None] * (1 + seed if success else 0)
        np.savez(tmp_path / f"click_alarmclock-{sha}-TinyPolicy-25-{seed}.npz", **arrays, log_variance=scores)
    assert main([*command, "--traces", str(tmp_path)]) == 0
    assert "100% of 10 failures" in capsys.readouterr().out
    found = json.loads((tmp_path / "analysis-policy_best" / "analysis.json").read_text())
    by_uncertainty, by_overlap = found["failures"].values()
    assert list(found["failures"]) == [
        f"click_alarmclock-{sha}-TinyPolicy-25, {by}" for by in ("s_k", "overlapping chunks")
    ]
    assert (by_uncertainty["auroc"]["value"], by_overlap["auroc"]["value"]) == (1, 0)  # here successes wander


def test_too_few_traces_of_one_execution_cost_nothing_of_the_page(command, capsys, tmp_path):
    sha = sha256(tmp_path / "policy_best.ckpt")[:8]
    arrays = {"seed": 0, "success": True, "steps": 4, "query": np.arange(1), "contacts": np.zeros((5, 2), bool)}
    arrays |= {"chunks": np.zeros((1, 5, 14)), "log_variance": np.zeros((1, 5))}
    np.savez(tmp_path / f"click_alarmclock-{sha}-TinyPolicy-aggregate-0.npz", **arrays)
    assert main([*command, "--traces", str(tmp_path)]) == 0
    assert "at least 4 successful and 2 failed episodes, got 1 and 0" in capsys.readouterr().out
    assert (tmp_path / "analysis-policy_best" / "analysis.json").is_file()


@pytest.mark.parametrize(("option", "says"), [("--budgets", "ranks"), ("--residuals", "ACT")])
def test_what_a_policy_cannot_do_is_said_before_anything_is_computed(command, option, says, capsys):
    assert main([*command, option]) == 2
    said = capsys.readouterr()
    assert says in said.err
    assert "statistic" not in said.out


def test_budgets_and_estimators_of_a_run_go_into_the_same_page(
    ten_demonstrations, tmp_path, tiny_act, untrained, capsys
):
    untrained(tiny_act(), tmp_path / "runs" / "a" / "version_0")
    command = f"analyze --run a --root {tmp_path}/runs --data {ten_demonstrations} --resamples 5 --budgets --estimators"
    assert main(command.split()) == 0
    folder = tmp_path / "runs" / "a" / "version_0" / "analysis-policy_best"
    found = json.loads((folder / "analysis.json").read_text())
    page, said = (folder / "analysis.md").read_text(), capsys.readouterr().out
    budgets = found["budgets"]
    assert budgets["ratios"] == [round(0.1 * tenth, 1) for tenth in range(11)]
    coarse = found["generalisation"]["validation"]["mean error"]
    for selector, intervals in budgets["error"].items():
        assert intervals[0]["value"] == pytest.approx(coarse), selector
        assert intervals[-1]["value"] == pytest.approx(budgets["error"]["learned"][-1]["value"]), selector
    assert budgets["against_coarse"]["learned"][0] == {"value": 0.0, "low": 0.0, "high": 0.0}
    assert budgets["against_coarse"]["learned"][-1]["value"] != 0, "the branch of this policy is not at its start"
    names = [row[0] for row in found["estimators"]]
    assert names == ["estimator", "s_k", "overlapping chunks"]
    for text in ("| 100% |", "| overlapping chunks |", "![budgets](budgets.png)"):
        assert text in page
    assert "overlapping chunks" in said
    assert np.asarray(Image.open(folder / "budgets.png")).std() > 0


def test_what_a_branch_could_correct_is_asked_on_episodes_that_nothing_was_trained_on(
    ten_demonstrations, tmp_path, tiny_act, untrained, monkeypatch
):
    split = Split(train=(0, 1, 2, 3, 4, 9), validation=(5, 6, 7, 8))
    monkeypatch.setattr("ugr_lightning.data.datamodule.split_episodes", lambda count, seed: split)
    untrained(tiny_act(), tmp_path)
    command = f"analyze {tmp_path}/policy_best.ckpt --data {ten_demonstrations} --resamples 20 --residuals"
    assert main(command.split()) == 0
    folder = tmp_path / "analysis-policy_best"
    found = json.loads((folder / "analysis.json").read_text())["foretold"]
    assert len(found) == 3
    for r2 in found.values():
        assert r2["low"] <= r2["value"] <= r2["high"] <= 1
    assert "| other new episodes, linear |" in (folder / "analysis.md").read_text()


def test_a_policy_without_an_uncertainty_is_asked_for_what_it_has(
    ten_demonstrations, tmp_path, tiny_act, untrained, capsys
):
    untrained(tiny_act(refine=None), tmp_path)
    command = ["analyze", str(tmp_path / "policy_best.ckpt"), "--data", str(ten_demonstrations), "--resamples", "5"]
    assert main(command) == 0
    assert "predicts no s_k" in capsys.readouterr().out
    assert main([*command, "--residuals"]) == 2  # two episodes are too few to fit on the others
    assert "at least 3 episodes, got 2" in capsys.readouterr().err
    for option in ("--budgets", "--estimators"):
        assert main([*command, option]) == 2
