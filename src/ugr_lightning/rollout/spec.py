"""What is to be rolled out: one frozen description from the command line down to the simulators."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ugr_lightning.errors import ConfigError
from ugr_lightning.rollout.film import check_film_name

SLOTS_PER_WORKER = 4
"""Episodes per process: while some wait for the policy, the others keep the process busy."""


@dataclass(frozen=True)
class RolloutSpec:
    """Which episodes are run, how, and what is kept of them.

    Args:
        task: a name from `ugr tasks`.
        seeds: one episode each.
        setting: how the surroundings vary.
        image_size: height and width of the pictures; those the policy was trained on.
        execution: `aggregate`, `aggregate-variance` or the number of steps executed of each chunk.
        seeds_hash: SHA-256 of the list that the seeds are from; None takes that of `seeds`.
        out: results file, one line per episode is appended; None for none.
        resume: run only the episodes that `out` lacks.
        traces: folder for what was predicted in each episode; None for none.
        videos: by seed the file, `.gif` or `.mp4`, of an episode that is filmed.
        workers: simulator processes, at most.
        slots_per_worker: episodes that run in a process side by side, at most.
        timeout_s: a process that takes longer to answer counts as hung.
        progress: whether to show a progress line.

    Raises:
        ConfigError: no seeds, no worker or slot, or a video of another ending.
    """

    task: str
    seeds: Sequence[int]
    setting: str = "demo_clean"
    image_size: tuple[int, int] = (120, 160)
    execution: str | int = "aggregate"
    seeds_hash: str | None = None
    out: Path | None = None
    resume: bool = False
    traces: Path | None = None
    videos: Mapping[int, Path] = field(default_factory=dict)
    workers: int = 2
    slots_per_worker: int = SLOTS_PER_WORKER
    timeout_s: float = 120.0
    progress: bool = True

    def __post_init__(self) -> None:
        if min(len(self.seeds), self.workers, self.slots_per_worker) < 1:
            got = f"{len(self.seeds)} seeds, {self.workers} workers with {self.slots_per_worker} slots"
            raise ConfigError("rollout", "at least one seed, and one worker with one slot", got, "Correct the number.")
        for path in self.videos.values():
            check_film_name(path)

    @property
    def shape(self) -> tuple[int, int]:
        """Processes, and episodes side by side in each, as far as there are seeds for them."""
        workers = min(self.workers, len(self.seeds))
        return workers, min(self.slots_per_worker, -(-len(self.seeds) // workers))
