from pathlib import Path

import pytest
import yaml

from ugr_lightning.cli.main import main
from ugr_lightning.cli.parsing.config import expand_includes, find_config, run_name
from ugr_lightning.errors import ConfigError

CONFIGS = Path(__file__).parents[3] / "configs"
TRAININGS = [path for path in sorted(CONFIGS.rglob("*.yaml")) if "benchmark" not in path.parts]
COMPLETE = [path for path in TRAININGS if "task" not in path.relative_to(CONFIGS).parts]


@pytest.mark.parametrize("path", TRAININGS, ids=lambda path: str(path.relative_to(CONFIGS)))
def test_every_config_parses_and_prints_a_config_that_parses(path, capsys, tmp_path):
    with pytest.raises(SystemExit) as done:
        main(["fit", "--config", str(path), "--print_config"])
    assert done.value.code in (0, None)
    printed = capsys.readouterr().out
    contents = [yaml.safe_load(Path(name).read_text()) for name in expand_includes(["--config", str(path)])[1::2]]
    given = [content["data"]["task"] for content in contents if "task" in content.get("data", {})]
    assert yaml.safe_load(printed)["data"]["task"] == (given or ["click_alarmclock"])[-1]
    (tmp_path / "again.yaml").write_text(printed)
    with pytest.raises(SystemExit):
        main(["fit", "--config", str(tmp_path / "again.yaml"), "--print_config"])
    assert capsys.readouterr().out == printed


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("base", {"refine": None, "causal": False}),
        ("cmask", {"refine": None, "causal": True}),
        ("full", {"refine": "Full"}),
        ("block", {"refine": "Block"}),
        ("uncert", {"refine": "Uncertainty"}),
    ],
)
@pytest.mark.parametrize("folder", ["", "paper"])
def test_the_five_variants_differ_only_in_what_they_are_named_for(folder, name, keys, capsys):
    def settings(variant):
        with pytest.raises(SystemExit):
            main(["fit", "--config", str(CONFIGS / folder / f"{variant}.yaml"), "--print_config"])
        return yaml.safe_load(capsys.readouterr().out)

    found, base = settings(name), settings("base")
    policy = found["model"]["policy"]["init_args"]
    refine = policy["refine"] and policy["refine"]["class_path"].rpartition(".")[2]
    assert {"refine": refine, "causal": policy["causal"]} == {"causal": False, **keys}
    for key in ("refine", "causal"):
        policy[key] = base["model"]["policy"]["init_args"][key]
    assert found == base


MUTATIONS = [
    ("trainer.max_stepz", "max_steps"),
    ("trainer.gradient_clip_value", "gradient_clip_val"),
    ("modle.learning_rate", "model"),
    ("model.learning_rat", "learning_rate"),
    ("model.warmup_step", "warmup_steps"),
    ("model.policy.init_args.dimm", "dim"),
    ("model.policy.init_args.kl_wieght", "kl_weight"),
    ("model.policy.init_args.state_drop_out", "state_dropout"),
    ("data.batchsize", "batch_size"),
    ("data.taks", "task"),
    ("data.sampling.first_frame_shar", "first_frame_share"),
    ("data.recording.noise_st", "noise_std"),
    ("average.decai", "decay"),
    ("rollout.every_n_step", "every_n_steps"),
    ("checkpoints.monitr", "monitor"),
    ("figures.every_n_validation", "every_n_validations"),
    ("seed_everythin", "seed_everything"),
]


@pytest.mark.parametrize(("key", "meant"), MUTATIONS)
def test_a_typo_is_one_paragraph_that_names_the_key_and_what_was_meant(key, meant, tmp_path, capsys):
    content: object = 1
    for part in reversed(key.split(".")):
        content = {part: content}
    (tmp_path / "typo.yaml").write_text(yaml.safe_dump(content))
    assert main(["fit", "--config", str(CONFIGS / "uncert.yaml"), "--config", str(tmp_path / "typo.yaml")]) == 2
    said = capsys.readouterr().err
    assert key.rpartition(".")[2] in said
    assert meant in said.partition("Did you mean")[2]
    assert "Traceback" not in said
    assert len(said.strip().splitlines()) == 2


@pytest.mark.parametrize(
    ("option", "key"),
    [
        ("--model.policy.init_args.dim=three", "dim"),
        ("--data.cache=disk", "cache"),
        ("--trainer.max_steps=many", "max_steps"),
        ("--model.policy.class_path=ugr_lightning.models.act.ACTT", "policy"),
        ("--model.schedule=linear", "schedule"),
    ],
)
def test_a_wrong_value_is_one_paragraph_that_names_the_key(option, key, capsys):
    assert main(["fit", "--config", str(CONFIGS / "base.yaml"), option]) == 2
    said = capsys.readouterr().err
    assert key in said
    assert "Traceback" not in said


def test_an_overlay_for_another_policy_is_answered_with_the_one_that_is_meant(capsys):
    assert main(["fit", "--config", "dp", "--config", "keyframes/act"]) == 2
    assert "`keyframes/act` sets it: did you mean `--config keyframes/dp`?" in capsys.readouterr().err


def test_the_config_of_an_older_run_is_told_what_is_gone_all_at_once(tmp_path, capsys):
    old = tmp_path / "config.yaml"
    gone = {"refine_branch": "mlp", "state_noise": 0.0}
    policy = {"class_path": "ugr_lightning.models.act.ACT", "init_args": gone}
    old.write_text(yaml.safe_dump({"model": {"policy": policy}, "rollout": {"on_missing_renderer": "warn"}}))
    assert main(["fit", "--config", str(old)]) == 2
    said = capsys.readouterr().err
    assert f"An older version wrote {old}: delete these keys there" in said
    assert "refine_branch mlp, state_noise 0.0, on_missing_renderer warn" in said


RULES = """
from ugr_lightning.models.refine.selector import Selector

class Mine(Selector):
    def __init__(self, spacing: int = 3):
        super().__init__()
        raise ValueError("no spacing is right")

    def budget(self, chunk_length): ...
    def select(self, log_variance, valid, training): ...

class Unfinished(Selector): ...
class Other: ...
"""


@pytest.mark.parametrize(
    ("named", "said"),
    [
        (
            "my_rulez.Mine",
            "model.policy.refine: expected the path of a Selector or null, got my_rulez.Mine, and there is",
        ),
        ("my_rules.Mien", "got my_rules.Mien, and my_rules has no Mien. Did you mean `Mine`?"),
        ("my_rules.Other", "got my_rules.Other, which is not derived from it."),
        ("my_rules.Unfinished", "which does not define budget, select."),
        ("my_broken.Mine", "which cannot be imported: NameError: name 'nothing' is not defined (my_broken.py, line 1)"),
        ("Nobody", "got Nobody. Write `package.module.Class`."),
        ("{class_path: my_rules.Mine, init_args: {spacing: x}}", "refine.spacing: expected a whole number, got x."),
        ("{class_path: my_rules.Mine, init_args: {spacng: 4}}", "Did you mean `spacing`?"),
        ("my_rules.Mine", "which refused: ValueError: no spacing is right (my_rules.py, line 7)"),
    ],
)
def test_a_class_that_cannot_be_a_selector_is_said_to_be_missing_or_what_else_is_wrong(
    named, said, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "my_rules.py").write_text(RULES)
    (tmp_path / "my_broken.py").write_text("nothing")
    content = f"model: {{policy: {{init_args: {{refine: {named}}}}}}}"
    (tmp_path / "mine.yaml").write_text(content)
    assert main(["fit", "--config", "smoke", "--config", "mine.yaml"]) == 2
    told = capsys.readouterr().err
    assert said in told
    assert "Traceback" not in told


def test_includes_come_first_and_are_relative_to_the_file(tmp_path):
    (tmp_path / "deep").mkdir()
    (tmp_path / "a.yaml").write_text("include: deep/b.yaml\n")
    (tmp_path / "deep" / "b.yaml").write_text("include: [c.yaml]\n")
    (tmp_path / "deep" / "c.yaml").write_text("")
    expanded = expand_includes(["--config", str(tmp_path / "a.yaml"), "--x", "1"])
    assert [Path(word).name for word in expanded[1:6:2]] == ["c.yaml", "b.yaml", "a.yaml"]
    assert expanded[6:] == ["--x", "1"]


def test_missing_and_circular_includes_are_errors(tmp_path):
    (tmp_path / "a.yaml").write_text("include: b.yaml\n")
    with pytest.raises(ConfigError, match=r"b\.yaml, which is not there"):
        expand_includes([f"--config={tmp_path / 'a.yaml'}"])
    (tmp_path / "b.yaml").write_text("include: a.yaml\n")
    with pytest.raises(ConfigError, match="include each other"):
        expand_includes([f"--config={tmp_path / 'a.yaml'}"])


@pytest.mark.parametrize("given", ["5", "[5]", "{a: b}", "[[base]]"])
def test_what_is_included_is_named_or_refused(tmp_path, given):
    (tmp_path / "a.yaml").write_text(f"include: {given}\n")
    with pytest.raises(ConfigError, match="a name or path, or a list of them"):
        expand_includes([f"--config={tmp_path / 'a.yaml'}"])


def test_a_run_is_named_after_its_configs():
    assert (
        run_name(["--config", "configs/uncert.yaml", "--config=configs/task/handover_block.yaml"])
        == "uncert-handover_block"
    )
    assert run_name(["-c", "configs/paper/base.yaml"]) == "paper-base"
    assert run_name([]) == "run"


def test_a_shipped_config_is_found_by_its_name_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text("include: paper/base\n")
    expanded = expand_includes(["--config", "mine.yaml", "--config=task/compact/handover_block"])
    found = [Path(word).resolve() for word in expanded[1::2]]
    expected = ["paper/common", "paper/base", "mine", "task/handover_block", "task/compact/handover_block"]
    assert found == [
        (tmp_path if name == "mine" else CONFIGS) / f"{name}.yaml" for name in expected
    ]  # a path of one's own and names, each after what it includes
    assert find_config("table1", "", under="benchmark") == CONFIGS / "benchmark" / "table1.yaml"


def test_a_file_of_ones_own_goes_before_a_shipped_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "base.yaml").write_text("")
    assert find_config("base.yaml", "--config") == Path("base.yaml")
    assert find_config("base", "--config") == CONFIGS / "base.yaml"


@pytest.mark.parametrize(
    ("name", "said"),
    [("uncret", "`uncert`"), ("handover_block", "`task/compact/handover_block`"), ("xyz", "Names are")],
)
def test_an_unknown_name_is_answered_with_near_ones_or_all(name, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=name) as raised:
        find_config(name, "--config")
    assert said in str(raised.value)
