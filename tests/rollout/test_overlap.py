import numpy as np
import pytest
from deployed import Recaller, tiny_act
from torch import nn

from ugr_lightning.models.normalizer import Normalizer
from ugr_lightning.rollout.overlap import HORIZON, Overlap, action_unit, near_disagreement


def test_distances_count_in_units_of_each_action_and_the_far_end_of_a_chunk_does_not_count():
    chunks = np.zeros((2, HORIZON + 9, 2))
    chunks[1, :, 1] = 6.0
    chunks[1, HORIZON:] = 1e6
    overlap = Overlap(HORIZON + 9, np.array([1.0, 2.0]))
    assert np.isnan(near_disagreement(overlap.push(0, chunks[0])))
    assert near_disagreement(overlap.push(2, chunks[1])) == pytest.approx(3.0)


@pytest.mark.parametrize(("step", "known"), [(4, 1), (5, 0), (50, 0)])
def test_a_chunk_behind_the_end_of_all_others_has_nothing_to_disagree_with(step, known):
    overlap = Overlap(5, np.ones(2))
    overlap.push(0, np.ones((5, 2)))
    distances = overlap.push(step, np.zeros((5, 2)))
    assert np.isfinite(distances).sum() == known


def test_the_unit_is_what_the_policy_normalises_by_where_it_does():
    assert action_unit(tiny_act()) == pytest.approx(np.full(14, 0.2))
    assert action_unit(Recaller()).tolist() == [1.0] * 14
    still = Recaller()
    still.normalizer = Normalizer(14, 14, "min_max")
    nn.init.zeros_(still.normalizer.action_scale)
    still.normalizer.fitted.fill_(True)
    assert action_unit(still).tolist() == [1.0] * 14, "of what never moves no distance is divided by nothing"
