from pathlib import Path

import pytest

from ugr_lightning.cli.benchmark.grid import fingerprint, read_grid, resolved_config
from ugr_lightning.errors import ConfigError
from ugr_lightning.sim.tasks import task_names

GRIDS = sorted((Path(__file__).parents[3] / "configs" / "benchmark").rglob("*.yaml"))


@pytest.mark.parametrize("path", GRIDS, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_every_grid_that_ships_names_tasks_and_configs_that_exist(path):
    grid = read_grid(path)
    jobs = grid.jobs()
    assert (
        len({job.name for job in jobs}) == len(jobs) == len(grid.policies) * len(grid.tasks) * len(grid.training_seeds)
    )
    assert set(grid.tasks) <= set(task_names())
    assert resolved_config(jobs[-1])["seed_everything"] == grid.training_seeds[-1]


@pytest.mark.parametrize("table", ["table1", "table2"])
def test_the_grids_of_both_sizes_compare_the_same_policies(table):
    compact, paper = (read_grid(path) for path in sorted(GRIDS, key=lambda p: len(p.parts)) if path.stem == table)
    assert paper.path.parent.name == "paper"
    assert list(compact.policies) == list(paper.policies)
    assert list(compact.tasks) == list(paper.tasks)


def test_the_grid_of_controls_has_all_of_them():
    (grid,) = (read_grid(path) for path in GRIDS if path.stem == "controls")
    configs = {path.stem for path in (grid.path.parents[1] / "controls").glob("*.yaml")}
    assert set(grid.policies) == configs


@pytest.fixture
def write(tmp_path):
    (tmp_path / "a.yaml").write_text("{}")

    def grid(text):
        path = tmp_path / "grid.yaml"
        path.write_text(text)
        return read_grid(path)

    return grid


GOOD = "policies: {base: a.yaml}\ntasks: {click_alarmclock: [a.yaml]}\n"


def test_defaults_are_one_training_seed_and_both_executions(write):
    (job,) = write(GOOD).jobs()
    assert job.name == "base-click_alarmclock-seed0"
    assert list(job.executions.values()) == ["aggregate", 25]
    assert job.modes == {}
    assert len(job.configs) == 2


def test_a_policy_may_be_executed_in_its_own_way_under_a_common_name(write):
    text = "policies: {ACT: a.yaml, DP: {configs: [a.yaml, a.yaml], executions: {published: 6}}}\n"
    act, dp = write(text + "tasks: {click_alarmclock: }\nexecutions: {published: aggregate}\n").jobs()
    assert (act.executions, dp.executions) == ({"published": "aggregate"}, {"published": 6})
    assert dp.modes == {"6": "published"}
    assert len(dp.configs) == 2


def test_overlays_come_last_and_training_seeds_change_slowest(write):
    jobs = write(GOOD + "training_seeds: [3, 1]\noverlays: a.yaml\n").jobs()
    assert [job.training_seed for job in jobs] == [3, 1]
    assert len(jobs[0].configs) == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("policies: {base: a.yaml}", "tasks"),
        ("- a", "mapping"),
        ("policies: [", "YAML"),
        (GOOD + "training_seed: [1]", "`training_seeds`"),
        (GOOD + "training_seeds: []", "training_seeds"),
        (GOOD + "training_seeds: [1, 1]", "each once"),
        (GOOD + "training_seeds: [-1]", "from 0"),
        (GOOD + "episodes: many", "episodes"),
        (GOOD + "checkpoint: first", "best_loss"),
        (GOOD + "executions: [1.5]", "executions"),
        ("policies: {base: b.yaml}\ntasks: {click_alarmclock: a.yaml}", "b.yaml"),
        ("policies: {base: {config: a.yaml}}\ntasks: {click_alarmclock: a.yaml}", "`configs`"),
        ("policies: {../base: a.yaml}\ntasks: {click_alarmclock: a.yaml}", "rename"),
    ],
)
def test_what_is_wrong_with_a_grid_is_named(write, text, said):
    with pytest.raises(ConfigError, match=said):
        write(text)


def test_a_task_whose_config_chooses_another_is_refused(write, tmp_path):
    grid = write("policies: {base: a.yaml}\ntasks: {handover_block: a.yaml}\n")
    with pytest.raises(ConfigError, match=r"data\.task handover_block"):
        resolved_config(grid.jobs()[0])


def test_a_fingerprint_depends_on_what_is_trained_and_not_on_where():
    config = {"run": "a", "trainer": {"default_root_dir": "x", "max_steps": 5}}
    elsewhere = {"run": "b", "trainer": {"default_root_dir": "y", "max_steps": 5}}
    assert fingerprint(config) == fingerprint(elsewhere)
    assert fingerprint(config) != fingerprint({"run": "a", "trainer": {"default_root_dir": "x", "max_steps": 6}})
