"""The inference graph of a policy: from uint8 images and a state in robot units to actions in robot units."""

import copy
import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ugr_lightning.contract import ChunkPolicy, Observation
from ugr_lightning.errors import ConfigError, require_extra
from ugr_lightning.models.diffusion import DiffusionPolicy

Graph = Callable[..., Tensor]
"""The parts of an observation that a policy needs (see `inputs`) to actions (B, K, A), any B."""
ONNX_OPSET = 18


class Inference(nn.Module):
    """What is exported: one query with a latent of zero, normalisation included.

    Args:
        policy: one in fp32, see `in_fp32`.
    """

    def __init__(self, policy: ChunkPolicy) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, images: Tensor, state: Tensor, projection: Tensor | None = None) -> Tensor:
        """The parts of an observation to actions (B, K, A)."""
        return self.policy.predict(Observation(images, state, projection)).actions


def inputs(observation: Observation) -> dict[str, Tensor]:
    """The parts that an observation has, by name: what a graph is asked with, in this order."""
    return {name: part for name, part in observation._asdict().items() if part is not None}


def in_fp32(policy: ChunkPolicy) -> ChunkPolicy:
    """A copy that computes in fp32, where a policy has a choice; other programs do."""
    exact: Any = copy.deepcopy(policy).eval()
    if hasattr(exact, "precision"):
        exact.precision = "fp32"
    same: ChunkPolicy = exact
    return same


def export_graph(policy: ChunkPolicy, observation: Observation, path: Path) -> None:
    """Write the graph as a program of `torch.export`.

    Args:
        policy: not one that samples in steps.
        observation: an example of at least two samples, which fixes the size of the images.
        path: `.pt2` file; `torch.export.load(path).module()` is the graph.

    Raises:
        ConfigError: a policy without such a graph.
    """
    program = _trace(policy, observation)
    with _quiet():
        torch.export.save(program, path)


def load_graph(path: Path) -> Graph:
    """The graph that `export_graph` has written."""
    with _quiet():
        graph: Graph = torch.export.load(path).module()
    return graph


def export_onnx(policy: ChunkPolicy, observation: Observation, path: Path) -> None:
    """Write the graph as ONNX, with the inputs `images` and `state` (with keyframes `projection`) and `actions` out.

    Args:
        policy: not one that samples in steps.
        observation: an example of at least two samples, which fixes the size of the images.
        path: `.onnx` file, weights inside.

    Raises:
        ConfigError: a policy without such a graph, or the packages of the extra `onnx` are missing.
    """
    require_extra("--to onnx", "onnx", "onnx", "onnxruntime", "onnxscript")
    program = _trace(policy, observation)
    with _quiet():
        model = torch.onnx.export(
            program,
            dynamo=True,
            opset_version=ONNX_OPSET,
            input_names=list(inputs(observation)),
            output_names=["actions"],
            optimize=False,  # the runtime does
            verbose=False,
            custom_translation_table={torch.ops.aten.sort.stable: _stable_sort},
        )
        assert model is not None
        model.save(path)


def load_onnx(path: Path) -> Graph:
    """The graph that `export_onnx` has written, in onnxruntime on the CPU."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    def run(*parts: Tensor) -> Tensor:
        given = {one.name: part.numpy() for one, part in zip(session.get_inputs(), parts, strict=True)}
        return torch.from_numpy(session.run(["actions"], given)[0])

    return run


def _trace(policy: ChunkPolicy, observation: Observation) -> torch.export.ExportedProgram:
    if isinstance(policy, DiffusionPolicy):
        fix = "`--to safetensors` takes any policy."
        raise ConfigError("--to", "a policy that answers in one pass", "one that samples in steps", fix)
    batch = torch.export.Dim("batch")
    with _quiet():
        return torch.export.export(
            Inference(in_fp32(policy).for_inference()).eval(),
            tuple(inputs(observation).values()),
            dynamic_shapes=tuple({0: batch} for _ in inputs(observation)),
            strict=False,
        )


def _stable_sort(values: Any, stable: bool = True, dim: int = -1, descending: bool = False) -> Any:
    """A stable sort in ONNX: of equal values its TopK puts the one with the lower index first."""
    from onnxscript import opset18

    size = opset18.Shape(values, start=dim, end=dim + 1 or None)
    return opset18.TopK(values, size, axis=dim, largest=int(descending), sorted=1)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporters' remarks about packages that nobody needs here."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
