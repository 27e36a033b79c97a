import numpy as np
import pytest

from ugr_lightning.uncertainty.open_loop import (
    Errors,
    Followed,
    compare_parts,
    conclusion,
    error_table,
)


def followed(offset, *, still=True, n=3, steps=4, dim=2):
    """Commands of zero, predictions that are off by the given amounts, and arms that stand at 1."""
    demonstrated = np.zeros((n, steps, dim), np.float32)
    predicted = demonstrated + np.asarray(offset, np.float32)
    predicted[:, -1] = 1000.0
    valid = np.ones((n, steps), bool)
    valid[:, -1] = False
    place = np.ones((n, dim), np.float32) if still else None
    return Followed(predicted, demonstrated, valid, place, np.zeros(n, int), np.arange(n))


def test_errors_are_means_over_valid_steps_command_by_command():
    errors = compare_parts(followed([0.5, -0.25]), followed([1.0, 0.5]), np.array([2.0, 0.5]))
    assert errors.training.tolist() == [0.5, 0.25]
    assert errors.validation.tolist() == [1.0, 0.5]
    assert errors.still.tolist() == [1.0, 1.0]
    assert errors.overall() == pytest.approx((0.375, 0.75, 1.25))


def test_standing_still_is_left_out_where_states_are_no_commands():
    errors = compare_parts(followed([0.1, 0.1]), followed([0.1, 0.1], still=False), np.ones(2))
    assert errors.still is None
    assert errors.overall()[2] is None
    table = error_table(errors, ("0", "1"))
    assert table[0] == ("command, in its own unit", "training", "validation", "deviation")
    assert all(len(row) == 4 for row in table)
    assert "standing still" not in conclusion(errors, (3, 3))


def test_the_table_has_a_row_for_each_command_and_their_mean_last():
    table = error_table(
        compare_parts(followed([0.5, 0.25]), followed([1.0, 0.5]), np.array([2.0, 0.5])), ("0", "left_gripper")
    )
    assert table[1] == ("command 0", "0.5000", "1.0000", "1.0000", "2.0000")
    assert table[2][0] == "left gripper"
    assert table[-1] == ("mean, in deviations", "0.375", "0.750", "1.250", "1")


@pytest.mark.parametrize(
    ("training", "validation", "says"),
    [
        (0.6, 0.7, "does not fit the demonstrations"),
        (0.1, 0.31, "knows its demonstrations by heart"),
        (0.1, 0.29, "not much worse"),
    ],
)
def test_the_conclusion_tells_what_was_not_learned_from_what_was_learned_by_heart(training, validation, says):
    one = np.ones(2)
    text = conclusion(Errors(training * one, validation * one, one, one), (10, 5))
    assert says in text
    assert f"On 10 training episodes the commands are off by {training:.3f} standard deviations" in text
    assert f"on 5 validation episodes by {validation:.3f}; standing still would be off by 1.000" in text
