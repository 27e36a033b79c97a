import torch
from deployed import looking_act, save
from PIL import Image

from ugr_lightning.cli.main import main


def test_inspect_tells_what_things_are(recording, tiny_config, capsys, tmp_path):
    folder = recording / "click_alarmclock" / "demo_clean"
    assert main(["inspect", str(folder)]) == 0
    assert "5 demonstrations" in capsys.readouterr().out
    assert main(["inspect", str(folder / "data" / "episode1.hdf5"), "--picture", "sheet.png"]) == 0
    assert "12 decision steps" in capsys.readouterr().out
    assert Image.open("sheet.png").size == (3 * 12, 8 * 8)
    assert main(["fit", "--config", tiny_config]) == 0
    assert main(["inspect", "runs"]) == 0
    assert main(["inspect", "runs/tiny/version_0/last.ckpt"]) == 0
    out = capsys.readouterr().out
    assert "tiny.TinyPolicy" in out
    assert "cam_left_wrist" in out


def test_of_what_sees_only_the_statistics_of_the_demonstrations_are_shown(tmp_path, capsys):
    assert main(["inspect", str(save(looking_act(), tmp_path / "looking.ckpt"))]) == 0
    _, _, shown = capsys.readouterr().out.partition("buffers:\n")
    assert {line.split(".")[0].strip() for line in shown.splitlines()} == {"normalizer", "finder"}
    assert "finder.centre" in shown
    assert "running" not in shown


def test_a_damaged_checkpoint_does_not_hide_the_others_of_its_folder(tmp_path, capsys):
    whole = save(looking_act(), tmp_path / "whole.ckpt").read_bytes()
    (tmp_path / "half.ckpt").write_bytes(whole[: len(whole) // 2])
    assert main(["inspect", str(tmp_path)]) == 0
    half, other = capsys.readouterr().out.splitlines()
    assert "half.ckpt: cannot be read (" in half
    assert "whole.ckpt: step" in other


def test_inspect_refuses_what_it_does_not_know(tmp_path, capsys):
    torch.save([1], tmp_path / "list.ckpt")
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "list.ckpt", tmp_path / "none", tmp_path / "empty"):
        assert main(["inspect", str(path)]) == 2
        assert path.name in capsys.readouterr().err
