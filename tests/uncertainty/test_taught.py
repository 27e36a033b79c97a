"""A policy of whose chunks some steps are a better policy's."""

import pytest
import torch
from deployed import tiny_act

from ugr_lightning.bridges.export import made_up_observation
from ugr_lightning.models.refine.uncertainty import Uncertainty
from ugr_lightning.uncertainty.taught import RULES, Taught


def _pair():
    student = tiny_act(uncertainty_head=True)
    teacher = tiny_act()
    with torch.no_grad():
        teacher.action_head.bias += 0.5
    return student, teacher


@pytest.mark.parametrize("rule", RULES)
def test_the_chosen_steps_are_the_teachers_and_the_others_the_students(rule):
    student, teacher = _pair()
    seen = made_up_observation(student, (30, 40), samples=2)
    alone, better = student.predict(seen), teacher.predict(seen)
    taught = Taught(student, teacher, RULES[rule](0.3))
    for policy in (taught, taught.for_inference()):
        chunk = policy.predict(seen)
        assert chunk.refined.sum(1).tolist() == [3, 3]
        torch.testing.assert_close(chunk.actions[chunk.refined], better.actions[chunk.refined])
        torch.testing.assert_close(chunk.actions[~chunk.refined], alone.actions[~chunk.refined])
        torch.testing.assert_close(chunk.coarse, alone.actions)
    assert not torch.equal(alone.actions, better.actions)


def test_the_rule_is_told_what_the_student_is_unsure_of():
    student, teacher = _pair()
    seen = made_up_observation(student, (30, 40), samples=2)
    chunk = Taught(student, teacher, Uncertainty(0.3)).predict(seen)
    worst = chunk.log_variance.topk(3, dim=1).indices.sort(1).values  # (B, M)
    assert chunk.refined.nonzero()[:, 1].view(2, 3).tolist() == worst.tolist()
