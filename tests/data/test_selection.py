"""Demonstrations are chosen by task, by how many and by number, and what is mixed is said."""

from pathlib import Path

import pytest

from ugr_lightning.data.formats import EpisodeLocation
from ugr_lightning.data.selection import Selection, count_tasks, describe_tasks
from ugr_lightning.errors import ConfigError, DataError

WHERE = Path("folder")


def episodes(*tasks):
    return {number: EpisodeLocation(Path("x"), tasks=(task,) if task else ()) for number, task in enumerate(tasks)}


FOUND = episodes("click_bell", "open_door", "click_clock", "click_bell", "open_door", "click_bell")


@pytest.mark.parametrize(
    ("selection", "numbers"),
    [
        (Selection(), [0, 1, 2, 3, 4, 5]),
        (Selection("click_bell"), [0, 3, 5]),
        (Selection("click_*", 3), [0, 2, 3]),
        (Selection(("open_door", "click_clock")), [1, 2, 4]),
        (Selection((), (5, 0)), [5, 0]),
        (Selection("open_*", (4,)), [4]),
        (Selection((), 99), [0, 1, 2, 3, 4, 5]),
    ],
)
def test_tasks_numbers_and_lists_choose(selection, numbers):
    assert list(selection.choose(FOUND, WHERE)) == numbers


def test_what_is_not_there_is_named_with_what_is():
    with pytest.raises(ConfigError, match=r"push_.*click_bell \(3\), open_door \(2\), click_clock \(1\)"):
        Selection("push_*").choose(FOUND, WHERE)
    with pytest.raises(ConfigError, match=r"do not say their task.*folder of one task"):
        Selection("click_bell").choose(episodes(None, None), WHERE)
    with pytest.raises(DataError, match=r"episodes 1, 9.*3 episodes: 0, 3, 5"):
        Selection("click_bell", (0, 1, 9)).choose(FOUND, WHERE)
    for wrong in (0, -1, (), (1, 1)):
        with pytest.raises(ConfigError, match="episodes"):
            Selection((), wrong)


def test_tasks_are_counted_most_first_and_many_are_shortened():
    assert describe_tasks(count_tasks(FOUND.values())) == "click_bell (3), open_door (2), click_clock (1)"
    assert describe_tasks(count_tasks(episodes(*map(str, range(50))).values())).endswith("and 42 more")
