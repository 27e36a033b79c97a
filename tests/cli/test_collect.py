import json
import warnings
from pathlib import Path

import pytest

from ugr_lightning.cli.collect import check_recording
from ugr_lightning.cli.main import main
from ugr_lightning.data.datamodule import ChunkDataModule, Recording
from ugr_lightning.demos.noise import Noise
from ugr_lightning.errors import DataError
from ugr_lightning.sim.tasks import task_names, task_version


def test_collect_hands_its_options_on(monkeypatch, capsys):
    calls = []
    monkeypatch.setattr(
        "ugr_lightning.demos.collect.collect", lambda task, folder, **options: calls.append((task, folder, options))
    )
    command = "collect handover_block --episodes 3 --root d --image_size [6,8] --noise.std 0.01 --workers 1".split()
    assert main(command) == 0
    [(task, folder, options)] = calls
    assert (task, folder) == ("handover_block", Path("d/handover_block/demo_clean"))
    assert options["noise"] == Noise(std=0.01)
    assert (options["episodes"], options["image_size"], options["workers"]) == (3, (6, 8), 1)


def test_collect_records_all_tasks_one_after_another(monkeypatch, capsys):
    recorded = []
    monkeypatch.setattr("ugr_lightning.demos.collect.collect", lambda task, folder, **options: recorded.append(task))
    assert main(["collect", "all", "--root", "d"]) == 0
    assert recorded == list(task_names())
    assert f"d/{recorded[-1]}/demo_clean" in capsys.readouterr().out


def test_collect_explains_a_wrong_task_and_a_wrong_setting_before_it_makes_a_folder(tmp_path, capsys):
    assert main(["collect", "click_alarm_clock", "--root", str(tmp_path)]) == 2
    assert "Did you mean click_alarmclock" in capsys.readouterr().err
    assert main(["collect", "all", "--setting", "demo_random", "--root", str(tmp_path)]) == 2
    assert "Did you mean demo_randomized" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_collect_says_what_a_shard_leaves_to_be_done(monkeypatch, capsys):
    parts = []
    monkeypatch.setattr(
        "ugr_lightning.demos.collect.collect", lambda task, folder, **options: parts.append(options["part"])
    )
    for more in (["--shard", "3/8"], ["--shard", "1/1"], []):
        assert main(["collect", "hanging_mug", *more]) == 0
    assert parts == [slice(2, None, 8), slice(0, None, 1), slice(0, None, 1)]
    first, *others = capsys.readouterr().out.splitlines()
    assert "--shard 1/1 completes" in first
    assert others[0] == others[1]


@pytest.fixture
def recorded(tmp_path):
    """A data module over a folder of the mug that says how it was recorded, and that folder."""
    folder = tmp_path / "hanging_mug" / "demo_clean"
    folder.mkdir(parents=True)

    def recorded_as(content, **more):
        (folder / "recording.json").write_text(content)
        return ChunkDataModule(task="hanging_mug", root=str(tmp_path), **more)

    return recorded_as, folder


def test_a_training_warns_of_recordings_of_another_version_of_its_task(recorded):
    recorded_as, folder = recorded
    now = task_version("hanging_mug")
    with pytest.warns(UserWarning, match=f"version {now - 1} of hanging_mug; here it is version {now}. Move"):
        check_recording(recorded_as(json.dumps({"task_version": now - 1})))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_recording(recorded_as(json.dumps({"task_version": now})))
        check_recording(recorded_as("{}"))  # a recording from before versions
        check_recording(recorded_as(json.dumps({"task_version": now - 1}), folder=str(folder)))
    with pytest.raises(DataError, match="settings of a recording"):
        check_recording(recorded_as("{"))


def test_a_training_refuses_recordings_that_were_made_in_another_way_than_it_asks_for(recorded):
    recorded_as, folder = recorded
    small = json.dumps({"image_size": [60, 80], "noise": {"std": 0.0, "time_constant": 0.5, "attempts": 5}})
    for asked, said in ((Recording(noise_std=0.02), "noise_std 0.02"), (Recording(image_size=(30, 40)), "[30, 40]")):
        with pytest.raises(DataError) as refused:
            check_recording(recorded_as(small, recording=asked))
        assert said in refused.value.expected
        check_recording(recorded_as(small, recording=asked, folder=str(folder)))
    with pytest.warns(UserWarning, match=r"noise_std 0.0, image_size \[60, 80\], not with the defaults"):
        check_recording(recorded_as(small))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_recording(recorded_as(small, recording=Recording(noise_std=0.0, image_size=(60, 80))))
