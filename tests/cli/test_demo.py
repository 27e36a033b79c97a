from ugr_lightning.cli.main import main


def test_demo_trains_evaluates_and_ends_with_a_table(tiny_config, world, capsys):
    world.succeeds = lambda seed, actor, execution: actor.name == "expert"
    assert main(["demo", "--config", f"[{tiny_config}]", "--episodes", "12"]) == 0
    assert [(call["actor"], call["task"], len(call["seeds"]), call["execution"]) for call in world] == [
        ("zero", "click_alarmclock", 10, "aggregate"),
        ("expert", "click_alarmclock", 10, "aggregate"),
        ("TinyPolicy", "click_alarmclock", 12, 5),  # its whole chunk
    ]
    assert [[path.name for path in call["videos"].values()] for call in world] == [[], [], ["episode.gif"]]
    assert len({id(call["simulators"]) for call in world}) == 1, "all rollouts share their simulators"
    out = capsys.readouterr().out
    assert "ugr test --root runs --run demo" in out
    assert "tensorboard --logdir runs" in out
    assert "TinyPolicy" in out
