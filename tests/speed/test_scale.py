import json
import math
import os

import yaml

from ugr_lightning.cli.main import main
from ugr_lightning.data.formats import find_format
from ugr_lightning.errors import ConfigError, RenderError
from ugr_lightning.speed import made_up, scale
from ugr_lightning.speed.scale import Growth, TrainingSize, cells_of_growth, measure_growth, scale_figure, sizes


def refuse(*_):
    raise ConfigError("data.cache", "frames that fit into 1.0 GB of memory", "78 GB", "Use `none`.")


def test_only_one_thing_is_varied_at_a_time_and_everything_is_varied():
    base = sizes()["cameras"]["3"]
    assert base == TrainingSize()
    varied = [
        {field for field, was, now in zip(size._fields, base, size, strict=True) if was != now} - {"cache"}
        for values in sizes().values()
        for size in values.values()
    ]
    assert max(map(len, varied)) == 1
    assert set.union(*varied) == {"demonstrations", "cameras", "image_size", "chunk_length"}
    assert list(sizes()["demonstrations, cache none"]) == ["50", "500", "5000"]


def test_the_sizes_that_stay_are_those_of_the_config(pytestconfig):
    config = yaml.safe_load((pytestconfig.rootpath / "configs" / "compact.yaml").read_text())["data"]
    assert config["batch_size"] == TrainingSize().batch
    assert (config["sampling"]["samples_per_epoch"], config["sampling"]["first_frame_share"]) == (1600, 0.15)


def test_a_training_of_its_own_process_tells_what_it_costs():
    size = sizes(quick=True)["demonstrations, cache none"]["20"]
    cost = scale._train(size, rounds=1)
    assert cost["start_s"] > 1  # imports alone take longer
    assert cost["step_ms"] > 0
    assert cost["peak_gb"] >= cost["own_gb"] > 0.1
    assert cost["validation"] == 4  # every fifth of six steps of four demonstrations, two a batch


def test_a_size_that_is_refused_says_why_and_the_others_are_measured(monkeypatch):
    monkeypatch.setattr(scale, "_train", lambda size, _: refuse() if size.cameras == 6 else {"start_s": 1.0})
    monkeypatch.setattr(scale, "_simulate", lambda *_: (_ for _ in ()).throw(RenderError("here", "a", "b", "c")))
    rows = list(measure_growth(quick=True))
    refused = [row for row in rows if row.refused]
    assert [(row.varied, row.value) for row in refused] == [
        ("cameras", "6"),
        *(("simulator processes", count) for count in "124"),
    ]
    assert "got 78 GB. Use `none`." in cells_of_growth(refused[0])[-1]
    assert all(row.start_s == 1 for row in rows if not row.refused)


def test_made_up_demonstrations_are_as_many_as_asked_for_and_all_but_a_few_take_no_room(tmp_path):
    made_up.write_many(tmp_path, 7, 3, (12, 20), ("cam_high", "camera_3"))
    form = find_format("robotwin")
    found = form.find(tmp_path)
    assert list(found) == list(range(7))
    assert len({os.stat(place.path).st_ino for place in found.values()}) == made_up.DIFFERENT
    episode = form.read(found[6], ("cam_high", "camera_3"))
    assert (episode.length, episode.image_size) == (3, (12, 20))


def test_curves_have_a_column_for_what_is_varied_and_a_line_for_each_cache():
    rows = [Growth("demonstrations, cache ram", "50", 9.0, 2000.0, 1.5, 1.0), Growth("cameras", "1", 9.0, 900.0, 1.0)]
    rows += [Growth("demonstrations, cache none", str(count), 9.0, 2000.0, 1.0) for count in (50, 500)]
    rows += [Growth("demonstrations, cache ram", "500", refused="too many")]
    rows.append(Growth("processes", "1", step_ms=9.0))
    figure = scale_figure(rows)
    first, second, *_ = figure.axes
    assert [axis.get_visible() for axis in figure.axes[2::3]] == [False, True, False], "no empty pictures"
    assert [axis.get_title() for axis in (first, second)] == ["demonstrations", "cameras"]
    ram, none = first.get_lines()
    assert (ram.get_label(), none.get_label()) == ("cache ram", "cache none")
    assert ram.get_ydata()[0] == 9
    assert math.isnan(ram.get_ydata()[1])


def test_the_command_writes_curves_and_numbers_and_measures_nothing_else(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scale, "_train", lambda *_: {"start_s": 9.0, "step_ms": 2000.0, "peak_gb": 1.0, "own_gb": 0.5})
    monkeypatch.setattr(scale, "_simulate", lambda *_: {"step_ms": 9.0})
    given = ["--out", str(tmp_path), "--json", str(tmp_path / "speed.json")]
    assert main(["speed", "scale", "--threads", "1", *given]) == 0
    assert (tmp_path / "scale.png").read_bytes().startswith(b"\x89PNG")
    rows = json.loads((tmp_path / "speed.json").read_text())["measurements"]
    said = capsys.readouterr().out
    assert {row["varied"] for row in rows} == {*sizes(), "simulator processes"}
    assert "9.0 s" in said
    assert "training step" not in said
