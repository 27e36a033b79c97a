"""One trained policy, many budgets: how many steps it refines is a choice at run time."""

import copy
import math
from typing import Any

from ugr_lightning.contract import ChunkPolicy
from ugr_lightning.errors import ConfigError
from ugr_lightning.models.refine.ranked import Ranked


def with_refine_ratio(policy: ChunkPolicy, ratio: float) -> ChunkPolicy:
    """A copy of a policy that refines another share of its chunks.

    Args:
        policy: one whose `refine` ranks steps by a score, such as `Uncertainty`.
        ratio: rho from 0 to 1; what rounds down to no step refines none, so that the coarse policy acts; 1 refines all.

    Raises:
        ConfigError: no share, or a policy that does not choose steps by a ranking.
    """
    if not 0 <= ratio <= 1:
        raise ConfigError("refine_ratio", "a share from 0 to 1", ratio, "The paper's is 0.3.")
    if not isinstance(getattr(policy, "refine", None), Ranked):
        got = type(getattr(policy, "refine", None) or policy).__name__
        fix = "Use a checkpoint trained with a ranking selector, e.g. configs/uncert.yaml."
        raise ConfigError("refine_ratio", "a policy that ranks steps", got, fix)
    changed: Any = copy.deepcopy(policy)
    if math.floor(ratio * policy.chunk_length + 1e-9) < 1:
        changed.refine = changed.budget = None
    else:
        changed.refine.ratio = ratio
        changed.budget = changed.refine.budget(policy.chunk_length)
    recut: ChunkPolicy = changed
    return recut
