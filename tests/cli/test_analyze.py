"""`ugr analyze` from a checkpoint to its tables and figures."""

import json

import numpy as np
import pytest
from PIL import Image

from ugr_lightning.cli.main import main


@pytest.fixture
def trained(tiny_config, ten_demonstrations):
    assert (
        main(
            [
                "fit",
                "--config",
                tiny_config,
                "--data.episodes",
                "10",
                "--data.after_end",
                "hold",
                "--data.root",
                str(ten_demonstrations),
            ]
        )
        == 0
    )
    return ["analyze", "--data", str(ten_demonstrations), "--resamples", "20"]


def test_analyze_writes_numbers_tables_and_figures_and_says_one_sentence(trained, capsys, tmp_path):
    assert main(trained) == 0
    said = capsys.readouterr().out
    folder = tmp_path / "runs" / "tiny" / "version_0" / "analysis-policy_best"
    found = json.loads((folder / "analysis.json").read_text())
    assert found["verdict"] in said
    assert "On 2 validation episodes s_k " in found["verdict"]
    assert json.loads((folder / "prior.json").read_text()) == found["position"]["training_error"]
    assert found["verdict"] in (folder / "analysis.md").read_text()
    assert {row["name"] for row in found["statistics"]} >= {"AUSE", "NLL, nats", "Spearman within position"}
    assert {"close", "open"} <= set(found["events"])  # the made-up grippers move at random
    for name in ("calibration", "events"):
        assert np.asarray(Image.open(folder / f"{name}.png")).std() > 0
    assert not list(folder.glob("*.partial"))


def test_analyze_refuses_other_episodes_than_those_of_the_split(trained, ten_demonstrations, capsys):
    data = ten_demonstrations / "click_alarmclock" / "demo_clean" / "data"
    (data / "episode9.hdf5").rename(data / "episode10.hdf5")
    assert main(trained) == 2
    assert "split" in capsys.readouterr().err
