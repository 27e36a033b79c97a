from pathlib import Path

from ugr_lightning.cli.main import main
from ugr_lightning.rollout.noise import Noise


def test_collect_hands_its_options_on(monkeypatch, capsys):
    calls = []
    monkeypatch.setattr(
        "ugr_lightning.rollout.collect.collect", lambda task, folder, **options: calls.append((task, folder, options))
    )
    command = (
        "collect --task handover_block --episodes 3 --root d --image_size [6,8] --noise.std 0.01 --workers 1".split()
    )
    assert main(command) == 0
    [(task, folder, options)] = calls
    assert (task, folder) == ("handover_block", Path("d/handover_block/demo_clean"))
    assert options["noise"] == Noise(std=0.01)
    assert (options["episodes"], options["image_size"], options["workers"]) == (3, (6, 8), 1)


def test_tasks_lists_them(capsys):
    assert main(["tasks"]) == 0
    assert "handover_block" in capsys.readouterr().out
