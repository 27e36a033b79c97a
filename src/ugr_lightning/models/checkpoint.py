"""Checkpoints that are complete in themselves, written atomically and read without running any code."""

import hashlib
import pickle
import platform
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal, TypedDict, cast

import torch

from ugr_lightning.blueprint import rebuild
from ugr_lightning.contract import ChunkPolicy
from ugr_lightning.errors import CheckpointError, ConfigError
from ugr_lightning.models.policy_folder import folder_sha256, read_policy_folder
from ugr_lightning.system.files import publish

FORMAT = 1
_PREFIX = "policy."
_DESCRIBED = {"blueprint": dict, "cameras": list, "data": dict, "versions": dict} | dict.fromkeys(
    ("chunk_length", "state_dim", "action_dim"), int
)


class TrainingData(TypedDict, total=False):
    """Where the training episodes of a policy came from; checkpoints that are imported or older lack some."""

    task: str
    setting: str
    image_size: Sequence[int]
    """H, W"""
    state: Literal["commanded", "measured"]
    action_offset: int
    after_end: Literal["mask", "hold"]
    normalise_over: Literal["train", "all"]
    episodes: int | Sequence[int]
    """how many, or their numbers"""
    split_seed: int
    split: dict[str, Any]
    """names and seeds of the episodes that train and of those that validate"""
    elsewhere: bool
    """whether they were in a folder of their own, `data.folder`"""
    layout: dict[str, Any]
    tasks: Sequence[str]
    control_hz: float | None


@dataclass(frozen=True)
class PolicyInfo:
    """What a checkpoint says about itself.

    Args:
        path: file it was read from.
        sha256: hash of the file.
        step: optimiser steps of training.
        epoch: epochs of training.
        description: `ckpt["policy"]`: blueprint, cameras, chunk length, dimensions, data (task, setting, image size,
            state kind, split), versions, scores of the last validation.
    """

    path: Path
    sha256: str
    step: int
    epoch: int
    description: dict[str, Any]

    @property
    def data(self) -> TrainingData:
        """Where the training episodes came from."""
        return cast(TrainingData, self.description.get("data", {}))

    @property
    def trained_on(self) -> TrainingData:
        """`data`, where it says which episodes it was trained on and which validated.

        Raises:
            CheckpointError: a policy that was imported.
        """
        missing = [name for name in ("task", "setting", "episodes", "split_seed", "split") if name not in self.data]
        if missing:
            fix = "Imported policies do not know; roll them out (`ugr rollout FILE`), or train one here."
            raise CheckpointError(self.path, "the episodes it was trained on", f"no {', '.join(missing)}", fix)
        return self.data


def describe(policy: ChunkPolicy, datamodule: object) -> dict[str, Any]:
    """Everything beside the weights that a checkpoint needs, as plain containers.

    Args:
        policy: the policy that is saved.
        datamodule: where its data come from; what it has of `TrainingData` is stored.
    """
    data = {name: getattr(datamodule, name) for name in TrainingData.__annotations__ if hasattr(datamodule, name)}
    return {
        "format": FORMAT,
        "blueprint": policy.blueprint(),
        "cameras": [str(camera) for camera in policy.cameras],
        "chunk_length": int(policy.chunk_length),
        "state_dim": int(policy.state_dim),
        "action_dim": int(policy.action_dim),
        "data": plain(data),
        "versions": versions(),
    }


def plain(value: Any) -> Any:
    """Plain containers only, so that `weights_only=True` loads them; paths and enumerations become strings."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item) for item in value]
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (int, float)):
        return value + 0  # a NumPy scalar that subclasses float becomes a float
    return value.item() if hasattr(value, "item") else str(value)


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide results."""
    found = {"python": platform.python_version()}
    for name in ("ugr-lightning", "torch", "lightning", "numpy", "mani-skill", "sapien"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "absent"
    return found


def sha256(path: Path) -> str:
    """Hash of a file, as hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_checkpoint(path: Path | str, *, mmap: bool = False) -> dict[str, Any]:
    """Read tensors and plain containers from a file; code in it is refused, never run.

    Args:
        path: the file.
        mmap: read a tensor when it is first used, so that what a training alone needs, such as the optimiser's state,
            costs neither time nor memory. For readers that keep no tensor: those stay tied to the file.

    Raises:
        CheckpointError: no such file, damaged, or it holds anything else.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(path, "a checkpoint file", "nothing there", "`ugr inspect runs` lists what there is.")
    try:
        in_parts = mmap and zipfile.is_zipfile(path)  # torch wrote single streams before 1.6
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=in_parts)
    except pickle.UnpicklingError as error:
        got = f"something else ({_first_line(error)})"
        fix = "Such a file could run code when opened, so it is refused; use a checkpoint written by `ugr fit`."
        raise CheckpointError(path, "tensors and plain containers only", got, fix) from error
    except (PermissionError, MemoryError):  # a file that is whole
        raise
    except Exception as error:  # a damaged file fails in as many ways as there are opcodes
        got = f"a damaged file ({_first_line(error)})"
        raise CheckpointError(path, "a whole checkpoint", got, "Use another checkpoint of the run.") from error
    if not isinstance(content, dict):
        raise CheckpointError(path, "a dictionary", type(content).__name__, "Use a checkpoint from `ugr fit`.")
    return content


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:160]


def load_policy(path: Path | str) -> tuple[ChunkPolicy, PolicyInfo]:
    """Rebuild a trained policy from one file, ready to predict.

    Args:
        path: checkpoint file from `ugr fit`, or folder from `ugr export --to safetensors`.

    Returns:
        The policy in evaluation mode (averaged weights where training averaged them), and what the file says.

    Raises:
        CheckpointError: not such a file, unsafe, of a newer format, or of a policy that cannot be.
    """
    path = Path(path)
    content = read_policy_folder(path) if path.is_dir() else read_checkpoint(path, mmap=True)
    description = _description(path, content)
    try:
        policy = rebuild(description["blueprint"])
    except (CheckpointError, ConfigError) as error:  # the latter of a constructor that was given what it refuses
        written, here = description["versions"].get("ugr-lightning"), versions()["ugr-lightning"]
        fix = f"{error.fix} The checkpoint was written by ugr-lightning {written}, this is {here}."
        raise CheckpointError(f"{path}, {error.where}", error.expected, error.got, fix) from error
    weights = {k.removeprefix(_PREFIX): v for k, v in content["state_dict"].items() if k.startswith(_PREFIX)}
    try:
        policy.load_state_dict(weights)
    except RuntimeError as error:
        fix = "The code of the policy has changed since; check out the version named in the checkpoint."
        raise CheckpointError(path, "weights that fit the policy", str(error).splitlines()[-1].strip(), fix) from error
    digest = folder_sha256(path) if path.is_dir() else sha256(path)
    info = PolicyInfo(path, digest, content.get("global_step", 0), content.get("epoch", 0), description)
    return policy.eval(), info


def _description(path: Path, content: dict[str, Any]) -> dict[str, Any]:
    """What a checkpoint says about its policy, once it is clear that it says all that is relied on."""
    description = content.get("policy")
    if not isinstance(description, dict) or not isinstance(content.get("state_dict"), dict):
        fix = "Use a checkpoint from `ugr fit`; foreign ones go through the bridges."
        raise CheckpointError(path, "the entries `policy` and `state_dict`", sorted(map(str, content))[:12], fix)
    if description.get("format", 0) not in range(FORMAT + 1):
        raise CheckpointError(path, f"format {FORMAT} or older", description["format"], "Update ugr-lightning.")
    missing = [name for name, kind in _DESCRIBED.items() if not isinstance(description.get(name), kind)]
    if missing:
        fix = "Something has changed the file: use another checkpoint of the run."
        raise CheckpointError(path, "a complete description of its policy", f"no {', '.join(missing)}", fix)
    return description


def save_policy(
    path: Path | str, policy: ChunkPolicy, data: dict[str, Any], extra: dict[str, Any] | None = None
) -> None:
    """Write a policy that was not trained here as a checkpoint that `load_policy` reads.

    Args:
        path: file to write.
        policy: with its normalisation statistics.
        data: what is known of its training data: `task`, `setting`, `image_size`, `state`.
        extra: further entries of the checkpoint, tensors and plain containers.

    Raises:
        CheckpointError: the disk is full or read-only; what was there before is untouched.
    """
    state = {_PREFIX + name: value.detach().cpu().clone() for name, value in policy.state_dict().items()}
    description = {**describe(policy, None), "data": plain(data)}
    content = {"policy": description, "state_dict": state, "global_step": 0, "epoch": 0, **(extra or {})}
    write_checkpoint(path, content)


def write_checkpoint(path: Path | str, content: dict[str, Any]) -> None:
    """Write aside, flush to disk, then rename: a kill or a full disk leaves the previous checkpoint whole.

    Args:
        path: the file; its folder is made.
        content: tensors and plain containers.

    Raises:
        CheckpointError: the disk is full or read-only; what was there before is untouched.
    """
    path = Path(path)

    def write(partial: Path) -> None:
        with partial.open("wb") as file:
            torch.save(content, file)

    try:
        publish(path, write)
    except (OSError, RuntimeError) as error:
        fix = "Free some space; the previous checkpoint is untouched, and `--checkpoint last` goes on from it."
        raise CheckpointError(path, "a writable disk with room for a checkpoint", error, fix) from error
