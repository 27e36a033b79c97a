"""The ceiling of sparse refinement: some steps of a policy's chunks are those of a better policy."""

import torch
from torch import Tensor

from ugr_lightning.contract import Batch, Chunk, ChunkPolicy, Observation, Statistics
from ugr_lightning.errors import ConfigError
from ugr_lightning.models.refine.head import Head
from ugr_lightning.models.refine.ranked import Ranked
from ugr_lightning.models.refine.scattered import Scattered
from ugr_lightning.models.refine.uncertainty import Uncertainty

RULES: dict[str, type[Ranked]] = {"least certain": Uncertainty, "scattered": Scattered, "first": Head}
"""Which steps the teacher takes over, as tables name them."""


class Taught(ChunkPolicy):
    """Acts like the student, but for the steps that a rule chooses: there like the teacher, who sees the same.

    A branch that corrected these steps as well as the teacher acts would do as well.

    Args:
        student: whose chunks are corrected.
        teacher: who corrects them; of the same robot, cameras and chunk length.
        rule: which steps.

    Raises:
        ConfigError: a teacher of another kind.
    """

    def __init__(self, student: ChunkPolicy, teacher: ChunkPolicy, rule: Ranked) -> None:
        super().__init__()
        for name in ("cameras", "chunk_length", "state_dim", "action_dim", "observation_steps"):
            wanted, got = getattr(student, name), getattr(teacher, name)
            if wanted != got:
                fix = "Train both on the same demonstrations, with the same of these."
                raise ConfigError(f"teacher.{name}", f"that of the student, {wanted}", got, fix)
            setattr(self, name, wanted)
        self.needs_projection = student.needs_projection or teacher.needs_projection
        self.student, self.teacher, self.rule = student, teacher, rule

    def set_statistics(self, statistics: Statistics) -> None:
        self.student.set_statistics(statistics)

    def losses(self, batch: Batch) -> dict[str, Tensor]:
        """Those of the student; nothing is learned of the teacher."""
        return self.student.losses(batch)

    def predict(self, observation: Observation) -> Chunk:
        """The student's chunk with the teacher's steps in it; `coarse` is the student's alone."""
        plan, better = self.student.predict(observation), self.teacher.predict(observation)
        whole = torch.ones_like(plan.actions[..., 0], dtype=torch.bool)  # (B, K)
        chosen = self.rule.select(plan.log_variance, whole, False)  # (B, K)
        actions = torch.where(chosen[..., None], better.actions, plan.actions)  # (B, K, A)
        return plan._replace(actions=actions, coarse=plan.actions, refined=chosen)

    def for_inference(self) -> "Taught":
        return Taught(self.student.for_inference(), self.teacher.for_inference(), self.rule)
