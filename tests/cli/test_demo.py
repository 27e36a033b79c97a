from ugr_lightning.cli import rollout
from ugr_lightning.cli.main import main
from ugr_lightning.contract import EpisodeResult


def test_demo_trains_evaluates_and_ends_with_a_table(tiny_config, monkeypatch, capsys):
    asked, kept = [], set()

    def roll_out(policy, task, *, seeds, episodes, execution, **options):
        asked.append((policy.rpartition("/")[2], task, seeds, episodes, str(execution)))
        kept.add(options["keep"])
        name = policy if policy in ("zero", "expert") else "TinyPolicy"
        return [EpisodeResult(task, "demo_clean", 100000, "h", name, None, str(execution), name == "expert", 5)]

    monkeypatch.setattr(rollout, "roll_out", roll_out)
    assert main(["demo", "--config", f"[{tiny_config}]", "--episodes", "12"]) == 0
    assert asked[0] == ("zero", "click_alarmclock", "evaluation", 10, "aggregate")
    assert asked[2:] == [
        ("policy_best.ckpt", "click_alarmclock", "evaluation", 12, "aggregate"),
        ("policy_best.ckpt", "click_alarmclock", "evaluation", 12, "25"),
    ]
    assert len(kept) == 1, "all rollouts share their simulators"
    out = capsys.readouterr().out
    assert "tensorboard --logdir runs" in out
    assert "TinyPolicy" in out


def test_demo_outside_a_checkout_says_what_to_do(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["demo"]) == 2
    assert "checkout" in capsys.readouterr().err
