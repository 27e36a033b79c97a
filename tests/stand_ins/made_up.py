"""Made-up episodes and evaluations."""

from pathlib import Path

import numpy as np

from ugr_lightning.results.evaluations import Evaluation
from ugr_lightning.results.results import EpisodeResult


def episode(seed=100_000, success=True, **more):
    """One episode of a checkpoint."""
    about = {"task": "click_alarmclock", "setting": "demo_clean", "seed": seed, "seeds_hash": "hash", "policy": "ACT"}
    about |= {"checkpoint": "abc", "execution": "aggregate", "success": bool(success), "steps": 9}
    return EpisodeResult(**about | more)


def episodes(outcomes, *, first_seed=100_000, **more):
    """Episodes of one checkpoint, with the outcome of each seed."""
    return [episode(first_seed + i, success, **more) for i, success in enumerate(outcomes)]


def evaluation(policy, outcomes, *, training_seed=0, task="click_alarmclock", execution="aggregate", checkpoint=None):
    """One evaluation of a checkpoint, with the outcome of each seed."""
    checkpoint = checkpoint or f"{policy}{training_seed}"
    results = episodes(outcomes, task=task, execution=execution, checkpoint=checkpoint)
    return Evaluation(policy, training_seed, Path(f"{policy}-{task}-{training_seed}.jsonl"), results)


def drawn(policy, rate, *, n=100, seed=0, **options):
    """One with successes drawn at a rate; equal seeds give outcomes that fail on the same evaluation seeds."""
    return evaluation(policy, np.random.default_rng(seed).uniform(size=n) < rate, **options)
