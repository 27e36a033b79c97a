"""Importing this module registers every task with gymnasium, as `import mani_skill.envs` does for ManiSkill's own.

import gymnasium
import ugr_lightning.sim.environments
environment = gymnasium.make("UGR-ClickAlarmclock-v1", obs_mode="rgb")
"""

from ugr_lightning.sim.tasks import environment_id, load_task, task_names

ENVIRONMENTS: dict[str, type] = {environment_id(name): load_task(name) for name in task_names()}
