"""The data module records what is missing, splits, and gives the same batches however they are loaded or resumed."""

import lightning
import numpy as np
import pytest
import torch
from jsonargparse import ArgumentParser
from recordings import prepared, record
from torch import nn

from ugr_lightning.data import datamodule
from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.data.formats.robotwin import RoboTwin
from ugr_lightning.data.sampling import Sampling
from ugr_lightning.embodiment import CAMERAS, STATE_DIM
from ugr_lightning.errors import ConfigError, DataError


def _data(root, **options):
    given = {"root": str(root), "episodes": 5, "batch_size": 8, "chunk_length": 4, "val_stride": 2, "cache": "ram"}
    return ChunkDataModule(**{**given, **options})


def _ready(root, **options):
    return prepared(_data(root, **options))


def _epochs(data, count=2):
    loader, batches = data.train_dataloader(), []
    for epoch in range(count):
        loader.sampler.set_epoch(epoch)
        batches += list(loader)
    return batches


def _tensors(batch):
    return [*batch[:7], *batch.keyframes]


def _same(left, right):
    return len(left) == len(right) and all(
        torch.equal(a, b)
        for x, y in zip(left, right, strict=True)
        for a, b in zip(_tensors(x), _tensors(y), strict=True)
    )


def test_batches_do_not_depend_on_the_number_of_workers_or_the_cache(recording_root):
    alone = _epochs(_ready(recording_root))
    assert _same(alone, _epochs(_ready(recording_root, num_workers=2)))
    assert _same(alone, _epochs(_ready(recording_root, cache="memmap", num_workers=2)))
    assert _same(alone, _epochs(_ready(recording_root, cache="none")))
    assert not _same(alone, _epochs(_ready(recording_root, seed=1)))


def test_rests_are_left_out_of_training_and_validation_alike(tmp_path):
    resting = np.float32([0, 0, 0, 1, 1, 1, 2, 3])[:, None].repeat(14, axis=1)
    record(tmp_path, longer=0, commanded=resting)
    data = _ready(tmp_path, sampling=Sampling(rest=0.05), val_stride=1)
    trained = torch.cat([batch.step for batch in _epochs(data, 1)]).tolist()
    assert sorted(trained) == sorted([0, 2, 2, 5, 5, 5, 6] * 4)  # as many samples as frames
    assert torch.cat([batch.step for batch in data.val_dataloader()]).tolist() == [0, 2, 5, 6]


def test_training_and_validation_never_share_an_episode(recording_root):
    data = _ready(recording_root)
    train = torch.cat([batch.episode for batch in _epochs(data)]).unique().tolist()
    validation = torch.cat([batch.episode for batch in data.val_dataloader()]).unique().tolist()
    assert train == list(data.episode_split.train)
    assert validation == list(data.episode_split.validation)


def test_validation_is_the_whole_grid_the_same_every_time(recording_root):
    data = _ready(recording_root)
    first, second = list(data.val_dataloader()), list(data.val_dataloader())
    assert _same(first, second)
    steps = torch.cat([batch.step for batch in first]).tolist()
    assert steps == list(range(0, 10, 2))  # episode 1 has ten steps


def test_the_split_names_episodes_and_seeds_in_plain_containers(recording_root):
    assert _ready(recording_root).split == {
        "split_seed": 0,
        "train": ["episode0", "episode2", "episode3", "episode4"],
        "validation": ["episode1"],
        "train_seeds": [0, 2, 3, 4],
        "validation_seeds": [1],
    }


def test_after_setup_the_size_of_the_pictures_is_known_whether_it_was_given_or_not(recording_root):
    data = _ready(recording_root)
    assert data.image_size == data.demonstrations[0].image_size
    assert data.train_dataloader().dataset[0].images.shape[-2:] == data.image_size
    assert _ready(recording_root, image_size=(8, 8)).image_size == (8, 8)


def test_every_demonstration_is_read_once_however_often_data_are_prepared(recording_root, monkeypatch):
    read, paths = RoboTwin.read, []
    monkeypatch.setattr(
        RoboTwin, "read", lambda form, place, *given: paths.append(place.path) or read(form, place, *given)
    )
    data = _ready(recording_root, cache="memmap")
    data.prepare_data()  # as a second stage of a trainer does
    data.setup("validate")
    assert len(paths) == len(set(paths)) == 5


def test_reading_many_demonstrations_says_how_far_it_is(recording_root, monkeypatch, capsys):
    _ready(recording_root)
    assert "reading" not in capsys.readouterr().err
    monkeypatch.setattr(datamodule, "MANY", 5)
    _ready(recording_root)
    assert "click_alarmclock/demo_clean: 5/5" in capsys.readouterr().err


def test_files_that_are_no_demonstrations_are_named(tmp_path, capsys):
    folder = record(tmp_path, count=5)
    (folder / "data" / "backup.hdf5").touch()
    _data(tmp_path).prepare_data()
    assert capsys.readouterr().err == f"{folder}: files that are taken for no demonstrations: backup.hdf5\n"


def test_missing_episodes_are_recorded(tmp_path):
    data = _data(tmp_path, task="handover_block")
    asked = []

    def recorder(module):
        asked.append((module.task, module.episodes, module.folder, module.recording.image_size))
        record(tmp_path, count=5, task="handover_block")

    data.recorder = recorder
    data.prepare_data()
    data.prepare_data()
    folder = tmp_path / "handover_block" / "demo_clean"
    assert asked == [("handover_block", 5, folder, (120, 160))]
    data.setup()
    assert len(data.demonstrations) == 5


def test_missing_episodes_without_a_recorder_say_which_command_to_run(tmp_path):
    record(tmp_path, count=3)
    with pytest.raises(DataError, match=r"5 demonstrations, got 3.*ugr collect click_alarmclock --episodes 5 --root /"):
        _data(tmp_path).prepare_data()


def test_a_recorder_that_records_too_little_is_not_believed(tmp_path):
    data = _data(tmp_path)
    data.recorder = lambda module: None
    with pytest.raises(DataError, match="5 demonstrations, got 0"):
        data.prepare_data()


def test_cameras_come_in_the_order_asked_for(recording_root):
    usual, turned = _ready(recording_root), _ready(recording_root, cameras=CAMERAS[::-1])
    left, right = usual.data[3].images, turned.data[3].images
    assert torch.equal(left, right.flip(1))
    assert _ready(recording_root, cameras=("cam_high",)).data[0].images.shape[1] == 1


@pytest.mark.parametrize("name", ["episodes", "batch_size", "val_stride", "num_workers", "seed"])
def test_impossible_numbers_name_the_setting(name, recording_root):
    with pytest.raises(ConfigError, match=f"data.{name}"):
        _data(recording_root, **{name: -1})


def test_every_option_can_be_given_on_the_command_line(recording_root):
    parser = ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(ChunkDataModule, "data")
    arguments = ["--data.sampling.mode=per_episode", "--data.recording.noise_std=0.1", "--data.image_size=[12,16]"]
    options = parser.instantiate(parser.parse_args([*arguments, f"--data.root={recording_root}"])).data
    assert options.sampling.mode == "per_episode"
    assert options.recording.noise_std == 0.1
    assert options.image_size == (12, 16)
    assert parser.get_defaults().data.cameras == CAMERAS
    help_text = " ".join(parser.format_help().split())
    assert help_text.count("(type:") >= 24
    assert "validation uses every `val_stride`-th step" in help_text


class _Watcher(lightning.LightningModule):
    """Remembers which frames it was trained and validated on."""

    def __init__(self):
        super().__init__()
        self.weights = nn.Linear(STATE_DIM, 1)
        self.seen, self.validated = [], []

    def training_step(self, batch, _):
        self.seen.append((self.current_epoch, list(zip(batch.episode.tolist(), batch.step.tolist(), strict=True))))
        return self.weights(batch.state).mean()

    def validation_step(self, batch, _):
        self.validated += list(zip(batch.episode.tolist(), batch.step.tolist(), strict=True))

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 1e-3)


def _fit(data, folder, *, epochs=3, save_every=None, **options):
    saver = lightning.pytorch.callbacks.ModelCheckpoint(
        folder, save_top_k=-1, every_n_train_steps=save_every, filename="{step}", enable_version_counter=False
    )
    trainer = lightning.Trainer(
        max_epochs=epochs, accelerator="cpu", logger=False, callbacks=[saver], enable_progress_bar=False,
        enable_model_summary=False, num_sanity_val_steps=0, **options.pop("trainer", {}),
    )  # fmt: skip
    watcher = _Watcher()
    trainer.fit(watcher, data, weights_only=False, **options)
    return watcher


SAMPLING = Sampling(samples_per_epoch=24)  # three batches of eight


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("workers", [0, 2])
def test_each_epoch_has_its_own_order_in_a_real_training(workers, recording_root, tmp_path):
    data = _data(recording_root, sampling=SAMPLING, num_workers=workers)
    watcher = _fit(data, tmp_path)
    expected = [
        (
            epoch,
            [tuple(pair) for pair in zip(*(part.tolist() for part in data.data.frames.locate(frames)), strict=True)],
        )
        for epoch in range(3)
        for frames in data.train_order(epoch).reshape(3, 8)
    ]
    assert watcher.seen == expected
    assert watcher.validated == [(1, step) for step in range(0, 10, 2)] * 3


@pytest.mark.filterwarnings("ignore", "error:.*not resumable")
@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("step", [2, 3, 4, 6])
def test_a_resumed_training_continues_with_the_next_batch(step, workers, recording_root, tmp_path):
    whole = _fit(_data(recording_root, sampling=SAMPLING), tmp_path, save_every=1)
    data = _data(recording_root, sampling=SAMPLING, num_workers=workers)
    resumed = _fit(data, tmp_path / "again", ckpt_path=tmp_path / f"step={step}.ckpt")
    assert [frames for _, frames in resumed.seen] == [frames for _, frames in whole.seen[step:]]
    assert torch.equal(resumed.weights.weight, whole.weights.weight)


@pytest.mark.filterwarnings("ignore")
def test_overfitting_on_a_few_batches_keeps_the_batch_size(recording_root, tmp_path):
    watcher = _fit(_data(recording_root), tmp_path, epochs=2, trainer={"overfit_batches": 1})
    assert [len(frames) for _, frames in watcher.seen] == [8, 8]
    assert watcher.seen[0][1] == watcher.seen[1][1]
