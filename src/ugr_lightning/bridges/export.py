"""Policies of ours for other programs: written aside, read back, compared, and only then put in place."""

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from ugr_lightning.bridges.act_checkpoint import EXTRA, export_act, import_act
from ugr_lightning.bridges.act_statistics import read_act_statistics, write_act_statistics
from ugr_lightning.bridges.graph import Graph, export_graph, export_onnx, in_fp32, inputs, load_graph, load_onnx
from ugr_lightning.bridges.lerobot_folder import export_lerobot
from ugr_lightning.bridges.lerobot_policy import import_lerobot
from ugr_lightning.bridges.model_card import model_card
from ugr_lightning.contract import ChunkPolicy, Observation
from ugr_lightning.errors import CheckpointError, ConfigError
from ugr_lightning.models.act import ACT
from ugr_lightning.models.checkpoint import PolicyInfo, load_policy, read_checkpoint
from ugr_lightning.models.policy_folder import write_policy_folder
from ugr_lightning.results.results import EpisodeResult, read_results
from ugr_lightning.system.files import publish_folder

Target = Literal["act", "lerobot", "safetensors", "onnx", "torch"]
TOLERANCE: dict[Target, float] = {"act": 1e-5, "lerobot": 1e-5, "safetensors": 0.0, "onnx": 1e-4, "torch": 1e-4}
"""Largest difference of actions that is accepted, in robot units, and relative to values above 1."""


class Exported(NamedTuple):
    """What an export did.

    Args:
        files: names of the files in the folder.
        difference: largest difference between the actions of the policy and of what was written and read back, in
            robot units.
        notes: sentences about what was made up or left behind.
    """

    files: list[str]
    difference: float
    notes: list[str]


class _Job(NamedTuple):
    policy: ChunkPolicy
    info: PolicyInfo
    observation: Observation
    drop_refinement: bool


def export_policy(
    checkpoint: Path,
    to: Target,
    out: Path,
    *,
    drop_refinement: bool = False,
    image_size: tuple[int, int] | None = None,
    licence: str = "apache-2.0",
) -> Exported:
    """Write a policy for another program and check that what it will read gives the same actions.

    Args:
        checkpoint: file from `ugr fit` or an import, or a folder of safetensors.
        to: `act` for the original ACT code, `lerobot`, `safetensors` for this package and for tools that read such
            files, `onnx` or `torch` for the inference graph.
        out: folder that does not exist yet, or is empty.
        drop_refinement: leave a refinement branch behind where the target has no place for one.
        image_size: H and W of the images; None takes the checkpoint's.
        licence: of the weights, for the model card.

    Raises:
        ConfigError: the target cannot express the policy, or the folder is taken.
        CheckpointError: the checkpoint is not usable, or what was read back differs.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError("--out", "a folder that does not exist yet, or is empty", out, "Choose another folder.")
    policy, info = load_policy(checkpoint)
    size = image_size or info.data.get("image_size")
    if size is None:
        fix = "Give the images' height and width, e.g. `--image_size [480,640]`."
        raise ConfigError("--image_size", "a size, since the checkpoint names none", None, fix)
    job = _Job(policy, info, made_up_observation(policy, size), drop_refinement)
    done: list[Exported] = []

    def write(folder: Path) -> None:
        graph, notes = _WRITERS[to](job, folder)
        difference = _compare(graph, job, to)
        card = model_card(
            policy,
            info,
            name=out.resolve().name,
            use=_use(to, out.name, list(inputs(job.observation))),
            results=_results(checkpoint, info),
            licence=licence,
            notes=notes,
        )
        (folder / "README.md").write_text(card, encoding="utf-8")
        done.append(Exported(sorted(path.name for path in folder.iterdir()), difference, notes))

    try:
        publish_folder(out, write)
    except OSError as error:
        fix = "Free some space, or choose another."
        raise CheckpointError(out, "a folder that can be written", error, fix) from error
    return done[0]


def made_up_observation(policy: ChunkPolicy, image_size: Sequence[int], samples: int = 3) -> Observation:
    """Noise that a policy can look at: always the same, states spread as in its training.

    Args:
        policy: with its normalisation statistics.
        image_size: H and W.
        samples: B.
    """
    draw = torch.Generator().manual_seed(0)
    time = (policy.observation_steps,) if policy.observation_steps > 1 else ()
    shape = (samples, *time, len(policy.cameras), 3, *image_size)
    images = torch.randint(256, shape, dtype=torch.uint8, generator=draw)  # (B, [T,] V, 3, H, W)
    state = torch.randn(samples, *time, policy.state_dim, generator=draw)  # (B, [T,] S)
    normalizer: Any = getattr(policy, "normalizer", None)
    if normalizer is not None:
        state = normalizer.state_shift + state * normalizer.state_scale
    if not policy.needs_projection:
        return Observation(images, state)
    one_metre_away = torch.tensor([[1.5, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]])
    disturbed = 0.1 * torch.randn(samples, *time, len(policy.cameras), 3, 4, generator=draw)  # (B, [T,] V, 3, 4)
    return Observation(images, state, one_metre_away + disturbed)


def _compare(graph: Graph, job: _Job, to: Target) -> float:
    """The largest difference of actions; an error if it is too large. Asked with all samples, then with one."""
    policy = job.policy if to == "safetensors" else in_fp32(job.policy)
    worst = 0.0
    for rows in (slice(None), slice(0, 1)):
        parts = {name: part[rows] for name, part in inputs(job.observation).items()}
        chunk = policy.predict(Observation(**parts))
        plain = to in ("act", "lerobot") and chunk.coarse is not None
        wanted = chunk.coarse if plain and chunk.coarse is not None else chunk.actions  # (B, K, A)
        got = graph(*parts.values())  # (B, K, A)
        worst = max(worst, float((got - wanted).abs().max()))
        if not torch.allclose(got, wanted, rtol=TOLERANCE[to], atol=TOLERANCE[to]):
            fix = "Nothing was written. Please report it with the checkpoint's `ugr inspect`."
            raise CheckpointError(f"--to {to}", f"the same actions to {TOLERANCE[to]:g}", f"{worst:g} apart", fix)
    return worst


def _results(checkpoint: Path, info: PolicyInfo) -> list[EpisodeResult]:
    beside = sorted((checkpoint if checkpoint.is_dir() else checkpoint.parent).glob("evaluation*.jsonl"))
    return [one for path in beside for one in read_results(path) if one.checkpoint == info.sha256]


def _act(job: _Job, folder: Path) -> tuple[Graph, list[str]]:
    policy = _require_act(job, "act")
    extra = None if job.info.path.is_dir() else read_checkpoint(job.info.path).get(EXTRA)
    made = export_act(policy, extra, drop_refinement=job.drop_refinement)
    torch.save(made.weights, folder / "policy_best.ckpt")
    (folder / "dataset_stats.pkl").write_bytes(write_act_statistics(made.statistics))
    content = read_checkpoint(folder / "policy_best.ckpt")
    statistics = read_act_statistics(folder / "dataset_stats.pkl")
    heads = policy.blueprint()["init_args"]["heads"]
    again, _ = import_act(content, statistics, cameras=policy.cameras, heads=heads)
    return _asked(again), made.notes


def _lerobot(job: _Job, folder: Path) -> tuple[Graph, list[str]]:
    policy = _require_act(job, "lerobot")
    height, width = job.observation.images.shape[-2:]
    notes = export_lerobot(policy, folder, (height, width), drop_refinement=job.drop_refinement)
    return _asked(import_lerobot(folder)[0]), notes


def _safetensors(job: _Job, folder: Path) -> tuple[Graph, list[str]]:
    about = {"policy": job.info.description, "global_step": job.info.step, "epoch": job.info.epoch}
    write_policy_folder(folder, job.policy.state_dict(), about)
    return _asked(load_policy(folder)[0]), []


def _onnx(job: _Job, folder: Path) -> tuple[Graph, list[str]]:
    export_onnx(job.policy, job.observation, folder / "policy.onnx")
    return load_onnx(folder / "policy.onnx"), _of_graph(job)


def _torch(job: _Job, folder: Path) -> tuple[Graph, list[str]]:
    export_graph(job.policy, job.observation, folder / "policy.pt2")
    return load_graph(folder / "policy.pt2"), _of_graph(job)


def _of_graph(job: _Job) -> list[str]:
    height, width = job.observation.images.shape[-2:]
    return [
        f"the graph takes images of {height} x {width} (height x width), any number of samples, and computes in fp32"
    ]


def _require_act(job: _Job, to: Target) -> ACT:
    if not isinstance(job.policy, ACT):
        got = type(job.policy).__name__
        raise ConfigError(f"--to {to}", "an ACT policy", got, "`--to safetensors` takes any policy.")
    return job.policy


def _asked(policy: ChunkPolicy) -> Graph:
    def ask(*parts: Tensor) -> Tensor:
        return policy.predict(Observation(*parts)).actions

    return ask


_WRITERS: dict[Target, Callable[[_Job, Path], tuple[Graph, list[str]]]] = {
    "act": _act,
    "lerobot": _lerobot,
    "safetensors": _safetensors,
    "onnx": _onnx,
    "torch": _torch,
}


def _use(to: Target, name: str, given: list[str]) -> str:
    """How to run what was exported into a folder of a name: lines of shell or Python.

    Args:
        to: what it was exported to.
        name: of the folder.
        given: what a graph is asked with.
    """
    feed = ", ".join(f"'{part}': {part}" for part in given)
    return {
        "act": "Put `policy_best.ckpt` and `dataset_stats.pkl` where the original code keeps its checkpoints.",
        "lerobot": f"lerobot-eval --policy.path={shlex.quote(name)} --env.type=...",
        "safetensors": f"ugr test {shlex.quote(name)}",
        "onnx": f"session = onnxruntime.InferenceSession({f'{name}/policy.onnx'!r})\n"
        f"actions = session.run(['actions'], {{{feed}}})[0]",
        "torch": f"actions = torch.export.load({f'{name}/policy.pt2'!r}).module()({', '.join(given)})",
    }[to]


assert set(_WRITERS) == set(TOLERANCE) == set(get_args(Target))
