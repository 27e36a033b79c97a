"""An alarm for deployment: raised where chunks disagree, or an episode lasts, as rarely happens before a success."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ugr_lightning.errors import CheckpointError, ConfigError, DataError
from ugr_lightning.results.results import EpisodeResult, wilson_interval
from ugr_lightning.rollout.overlap import Overlap, near_disagreement
from ugr_lightning.system.files import publish_text
from ugr_lightning.system.records import checked_record, parse_json


@dataclass(frozen=True)
class Alarm:
    """What is rare in successful episodes of a checkpoint.

    Args:
        checkpoint: SHA-256 of the checkpoint.
        execution: how its chunks were executed.
        task, setting, seeds_hash: of the episodes that it was set on.
        successes: how many of them it was set on.
        rate: share of successful episodes of this kind, at most, in which it is raised; half of it for each reason.
        threshold: it is raised where a chunk disagrees more than this with earlier ones, see `near_disagreement`.
        steps: and with the first chunk after so many control steps.
    """

    checkpoint: str
    execution: str
    task: str
    setting: str
    seeds_hash: str
    successes: int
    rate: float
    threshold: float
    steps: int

    def __str__(self) -> str:
        return (
            f"execution {self.execution}: where chunks disagree by more than {self.threshold:.3g}, or from step "
            f"{self.steps} on; in at most {self.rate:.0%} of the successes, from {self.successes} of {self.task} "
            f"({self.setting})"
        )

    def raised(self, step: int, disagreement: float) -> bool:
        """Whether it is raised where a chunk was predicted.

        Args:
            step: control steps since the episode began.
            disagreement: of the chunk with earlier ones.
        """
        return disagreement > self.threshold or step >= self.steps


class Watch:
    """What is seen of an episode while it runs.

    Args:
        chunk_length: K.
        unit: (A,) see `Overlap`.
        alarm: what raises an alarm; None for none.

    Attributes:
        step: control steps so far; whoever executes them counts.
        raised: control step of the first alarm, or None.
    """

    def __init__(self, chunk_length: int, unit: np.ndarray, alarm: Alarm | None = None) -> None:
        self.step = 0
        self.raised: int | None = None
        self._overlap, self._alarm = Overlap(chunk_length, unit), alarm

    def see(self, chunk: np.ndarray) -> float:
        """How far a chunk (K, A) is from the earlier ones; 0 where it overlaps with none."""
        found = near_disagreement(self._overlap.push(self.step, chunk))
        found = 0.0 if math.isnan(found) else found
        if self.raised is None and self._alarm is not None and self._alarm.raised(self.step, found):
            self.raised = self.step
        return found


def conformal_threshold(scores: np.ndarray, level: float = 0.1) -> float:
    """The threshold that a new score of the same kind exceeds with at most a given probability.

    Args:
        scores: (n,) highest scores of successful episodes.
        level: that probability.

    Returns:
        The ceil((n + 1) (1 - level))-th smallest score.

    Raises:
        DataError: too few episodes for the level.

    Source: Vovk et al. (2005), split conformal prediction.
    """
    rank = math.ceil((len(scores) + 1) * (1 - level) - 1e-9)
    if rank > len(scores):
        least = math.ceil(1 / level - 1e-9) - 1
        fix = "Roll out more episodes, or allow more false alarms."
        raise DataError("successful episodes", f"at least {least} for a level of {level:g}", len(scores), fix)
    return float(np.sort(scores)[rank - 1])


def set_alarm(results: Sequence[EpisodeResult], rate: float) -> Alarm:
    """The alarm that the successes among some episodes give.

    Half of the rate is for chunks that disagree and half for episodes that last, so that the promise holds for both
    together. It holds on average over what the alarm could have been set on, not for each alarm.

    Args:
        results: of one checkpoint and execution.
        rate: share of successful episodes, at most, that it may be raised in.

    Raises:
        ConfigError: no rate.
        DataError: episodes of more than one kind, from before disagreement was kept, or too few successes.
    """
    if not 0 < rate < 1:
        raise ConfigError("--rate", "a share between 0 and 1", rate, "Say e.g. 0.1 for one success in ten.")
    kinds = {(item.checkpoint, item.execution, item.task, item.setting, item.seeds_hash) for item in results}
    if len(kinds) != 1 or len({item.seed for item in results}) < len(results):
        expected, got = "one task, setting and list of seeds, each seed once", f"{len(results)} of {len(kinds)} kinds"
        raise DataError("episodes", expected, got, "Write each list of seeds to a results file of its own, once.")
    good = [item for item in results if item.success]
    known = [item.disagreement for item in good if item.disagreement is not None]
    if len(known) < len(good):
        fix = "Roll out again; files from before there was an alarm do not say."
        raise DataError("episodes", "how far chunks disagree", f"none in {len(good) - len(known)} episodes", fix)
    least = math.ceil(2 / rate - 1e-9) - 1
    if len(good) < least:
        got = f"{len(good)} of {len(results)} episodes"
        fix = "Roll out more seeds, or promise less with a higher `--rate`."
        raise DataError("episodes", f"at least {least} successes for a rate of {rate:g}", got, fix)
    checkpoint, execution, task, setting, seeds_hash = kinds.pop()
    threshold = conformal_threshold(np.array(known), rate / 2)
    steps = int(conformal_threshold(np.array([item.steps for item in good]), rate / 2))
    return Alarm(str(checkpoint), execution, task, setting, seeds_hash, len(good), rate, threshold, steps)


def alarms_path(checkpoint: Path) -> Path:
    """Where the alarms of a checkpoint are: beside a file, in an exported folder."""
    return checkpoint / "alarm.json" if checkpoint.is_dir() else checkpoint.with_suffix(".alarm.json")


def write_alarms(checkpoint: Path, alarms: Sequence[Alarm]) -> Path:
    """Write the alarms of a checkpoint, complete or not at all, in place of those that were there.

    Args:
        checkpoint: the file or folder.
        alarms: one for each execution.
    """
    path = alarms_path(checkpoint)
    publish_text(path, json.dumps([asdict(alarm) for alarm in alarms], indent=1, allow_nan=False) + "\n")
    return path


def read_alarms(checkpoint: Path, sha256: str) -> dict[str, Alarm]:
    """The alarms of a checkpoint by execution; none where none were set.

    Args:
        checkpoint: the file or folder.
        sha256: of it.

    Raises:
        CheckpointError: a damaged file, or alarms of another checkpoint.
    """
    path = alarms_path(checkpoint)
    fix = f"Remove the file (`rm {path}`), or set the alarm anew with `ugr alarm`."
    if not path.is_file():
        return {}
    try:
        alarms = [checked_record(Alarm, entry, path, fix) for entry in _entries(path.read_bytes())]
    except DataError as error:
        raise CheckpointError(error.where, f"alarms from `ugr alarm`: {error.expected}", error.got, fix) from error
    except (OSError, ValueError) as error:
        raise CheckpointError(path, "alarms from `ugr alarm`", error, fix) from error
    if other := sorted({str(alarm.checkpoint)[:12] for alarm in alarms if alarm.checkpoint != sha256}):
        anew = f"Remove the file (`rm {path}`): then it can be rolled out, and `ugr alarm` can set its own."
        raise CheckpointError(path, f"alarms of checkpoint {sha256[:12]}", ", ".join(other), anew)
    return {alarm.execution: alarm for alarm in alarms}


def _entries(text: bytes) -> list[object]:
    found = parse_json(text)
    if not isinstance(found, list):
        raise ValueError(type(found).__name__)
    return found


def alarm_report(alarm: Alarm, results: Sequence[EpisodeResult]) -> str:
    """What an alarm promised and what came of it.

    Args:
        alarm: that watched.
        results: episodes, of which those count that it watched and that did not crash.
    """
    seen = [
        item for item in results if (item.execution, item.alarm_rate, item.crash) == (alarm.execution, alarm.rate, None)
    ]
    good, bad = ([item for item in seen if item.success is success] for success in (True, False))
    foreseen = [(item.alarm, item.steps - item.alarm) for item in bad if item.alarm is not None]
    text = f"Alarm, execution {alarm.execution}: in {_share(good)} successes ({alarm.rate:.0%} promised at most)"
    text += f" and in {_share(bad)} failures"
    if foreseen:
        early = sum(step < alarm.steps for step, _ in foreseen)
        lead = np.median([left for _, left in foreseen])
        text += f", {lead:.0f} steps (median) before their end, {early} of them where chunks disagreed and the others"
        text += f" because they lasted {alarm.steps} steps"
    kind = {(item.task, item.setting) for item in seen} - {(alarm.task, alarm.setting)}
    other = f" The promise is for {alarm.task} ({alarm.setting}) only." if kind else ""
    own = any(item.seeds_hash == alarm.seeds_hash for item in seen)
    return f"{text}.{other}" + (" These are the seeds that it was set on." if own else "")


def _share(results: Sequence[EpisodeResult]) -> str:
    """How many of some episodes had an alarm, with the interval of the share."""
    raised = sum(item.alarm is not None for item in results)
    low, high = wilson_interval(raised, len(results))
    return f"{raised} of {len(results)} [{low:.0%}, {high:.0%}]"
