"""Importing this module registers every task with gymnasium, as `import mani_skill.envs` does for ManiSkill's own.

import gymnasium
import ugr_lightning.sim.environments
environment = gymnasium.make("UGR-ClickAlarmclock-v1", obs_mode="rgb", render_mode="rgb_array")

The id `ugr_lightning.sim.environments:UGR-ClickAlarmclock-v1` makes gymnasium import it. As with all of ManiSkill's
environments, what goes out is torch tensors with a leading dimension of 1; `CPUGymWrapper` of
`mani_skill.utils.wrappers` makes them the numpy arrays without one that gymnasium's other environments give.
"""

from ugr_lightning.sim.tasks import environment_id, load_task, task_names

ENVIRONMENTS: dict[str, type] = {environment_id(name): load_task(name) for name in task_names()}
