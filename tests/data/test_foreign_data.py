"""Demonstrations of other formats and other robots train as ours do, and nobody records into their folders."""

import shutil

import h5py
import lightning
import numpy as np
import pytest
import torch
from recordings import prepared, record

from ugr_lightning.data.datamodule import ChunkDataModule
from ugr_lightning.data.folder import find_episodes
from ugr_lightning.data.formats import find_format
from ugr_lightning.data.formats.robotwin import read_episode
from ugr_lightning.data.layout import Joint, Layout
from ugr_lightning.data.sampling import Sampling
from ugr_lightning.embodiment import CAMERAS
from ugr_lightning.errors import DataError
from ugr_lightning.models.act import ACT
from ugr_lightning.training.module import PolicyModule

TINY = {"dim": 16, "feedforward": 16, "heads": 2, "encoder_layers": 1, "decoder_layers": 1, "cvae_layers": 1,
        "backbone_width": 8, "backbone_stem": "unshuffle", "backbone_norm": "batch", "chunk_length": 4}  # fmt: skip


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Five recordings, the same as processed ACT, and those as recordings again."""
    root = tmp_path_factory.mktemp("conversion")
    ours = record(root)
    episodes = [read_episode(path) for path in find_episodes(ours).values()]
    find_format("act").write(root / "act", episodes)
    converted = [find_format("act").read(at, CAMERAS) for at in find_format("act").find(root / "act").values()]
    find_format("robotwin").write(root / "back", converted)
    return {"ours": ours, "act": root / "act", "back": root / "back"}


def _data(folder, **options):
    given = {"episodes": 5, "batch_size": 8, "chunk_length": 4, "sampling": Sampling(samples_per_epoch=32)}
    return ChunkDataModule(folder=str(folder), **{**given, **options})


class _Losses(lightning.Callback):
    def __init__(self):
        self.values = []

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
        self.values.append(float(outputs["loss"]))


def _train(data, steps=20, **policy):
    lightning.seed_everything(0, verbose=False)
    losses = _Losses()
    trainer = lightning.Trainer(
        max_steps=steps, accelerator="cpu", logger=False, callbacks=[losses], enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, num_sanity_val_steps=0, limit_val_batches=0,
    )  # fmt: skip
    trainer.fit(PolicyModule(ACT(**{**TINY, **policy}), learning_rate=1e-3), data)
    return losses.values


@pytest.mark.filterwarnings("ignore")
def test_converted_demonstrations_train_to_the_same_first_20_losses(folders):
    reference = _train(_data(folders["ours"]))
    assert len(set(reference)) == 20
    assert _train(_data(folders["act"], cache="none")) == reference
    assert _train(_data(folders["back"])) == reference


@pytest.mark.filterwarnings("ignore")
def test_pictures_matter_to_those_losses(folders, tmp_path):
    """Otherwise equal losses would say nothing about pictures."""
    shutil.copytree(folders["act"], tmp_path / "act")
    for path in (tmp_path / "act").glob("*.hdf5"):
        with h5py.File(path, "r+") as file:
            for camera in CAMERAS:
                pictures = file[f"observations/images/{camera}"]
                pictures[...] = pictures[...] ^ 1
    assert _train(_data(tmp_path / "act"), 3) != _train(_data(folders["act"]), 3)


@pytest.mark.filterwarnings("ignore")
def test_one_arm_with_one_camera_trains(folders):
    joints = (*range(7, 13), Joint(13, closed=-1.0, open=3.0))
    layout = Layout(cameras={"wrist": "cam_right_wrist"}, state=joints)
    data = _data(folders["act"], cameras=("wrist",), layout=layout)
    losses = _train(data, 3, cameras=("wrist",), state_dim=7, action_dim=7)
    assert np.isfinite(losses).all()
    batch = next(iter(data.val_dataloader()))
    assert (batch.state.shape[1:], batch.actions.shape[1:], batch.images.shape[1]) == ((7,), (4, 7), 1)
    original = _data(folders["act"])
    original.setup()
    whole = next(iter(original.val_dataloader()))
    assert torch.equal(batch.state[:, :6], whole.state[:, 7:13])
    assert torch.allclose(batch.state[:, 6], (whole.state[:, 13] + 1) / 4)
    assert torch.equal(batch.images[:, 0], whole.images[:, CAMERAS.index("cam_right_wrist")])


@pytest.mark.parametrize("cache", ["memmap", "none"])
def test_the_caches_deliver_foreign_pictures(cache, folders, tmp_path):
    shutil.copytree(folders["act"], tmp_path / "act")
    plain = prepared(_data(folders["ours"]))
    cached = prepared(_data(tmp_path / "act", cache=cache, num_workers=0))
    frames = list(range(0, 30, 7))
    assert torch.equal(cached.data[frames].images, plain.data[frames].images)
    assert {path.name for path in tmp_path.iterdir()} == {"act"}


def test_a_memmap_of_one_layout_is_not_taken_for_another(folders, tmp_path):
    shutil.copytree(folders["act"], tmp_path / "act")
    seen = []
    for camera in ("cam_high", "cam_left_wrist"):
        data = _data(tmp_path / "act", cache="memmap", cameras=("view",), layout=Layout(cameras={"view": camera}))
        seen.append(prepared(data).data[[0]].images)
    assert not torch.equal(*seen)


def test_a_folder_of_another_format_under_the_root_is_read_and_never_recorded_into(folders, tmp_path):
    place = tmp_path / "click_alarmclock" / "demo_clean"
    shutil.copytree(folders["act"], place)
    data = ChunkDataModule(root=str(tmp_path), episodes=5, chunk_length=4)
    data.recorder = lambda module: pytest.fail("recorded into a foreign folder")
    assert len(prepared(data).demonstrations) == 5
    more = ChunkDataModule(root=str(tmp_path), episodes=9)
    more.recorder = data.recorder
    with pytest.raises(DataError, match=r"9 demonstrations, got 5\. Set `data\.episodes` to 5 or less"):
        more.prepare_data()


def test_a_folder_of_one_demonstration_is_not_told_to_train_on_one(folders):
    with pytest.raises(DataError, match=r"5 demonstrations, got 1\. Add others: at least 2 are needed"):
        _data(next(folders["act"].glob("*0.hdf5")), episodes=5).prepare_data()


@pytest.mark.parametrize("kind", ["ours", "empty"])
def test_a_folder_that_is_named_is_never_recorded_into(kind, folders, tmp_path):
    folder = folders["ours"] if kind == "ours" else tmp_path
    data = _data(folder, episodes=9)
    data.recorder = lambda module: pytest.fail("recorded into a folder that was named")
    with pytest.raises(DataError, match="got 5.*data.episodes" if kind == "ours" else "an empty folder"):
        data.prepare_data()
