"""The README of an exported policy: what it is, what it was trained on, how well it does, and how to run it."""

import json
from collections.abc import Sequence

from ugr_lightning.contract import ChunkPolicy
from ugr_lightning.models.checkpoint import PolicyInfo
from ugr_lightning.results.results import EpisodeResult, success_table

NAMES = {"train": "train episodes", "validation": "validation episodes"}


def model_card(
    policy: ChunkPolicy,
    info: PolicyInfo,
    *,
    name: str,
    use: str,
    results: Sequence[EpisodeResult],
    licence: str,
    notes: Sequence[str],
) -> str:
    """Write the card, as Markdown with the front matter that model hubs read.

    Args:
        policy: what is exported.
        info: what its checkpoint says.
        name: of the folder.
        use: how to run it: lines of shell or Python.
        results: episodes of this very checkpoint.
        licence: of the weights, as an SPDX name in lower case.
        notes: what the export has made up or left behind.
    """
    about = info.description
    split = info.data.get("split") or {}
    data = {key: value for key, value in info.data.items() if key != "split"}
    count = sum(parameter.numel() for parameter in policy.parameters())
    kind = about["blueprint"]["class_path"].rpartition(".")[2]
    lines = [
        "---",
        f"license: {licence}",
        "library_name: ugr-lightning",
        "pipeline_tag: robotics",
        "tags: [robotics, imitation-learning, action-chunking]",
        "---",
        "",
        f"# {name}",
        "",
        f"Policy `{kind}`, {count / 1e6:.2f} M parameters: {len(about['cameras'])} cameras and "
        f"{about['state_dim']} joint values in, chunks of {about['chunk_length']} x {about['action_dim']} commands "
        "out, robot units on both sides.",
        "",
        "```",
        use,
        "```",
        "",
        "## Data",
        "",
        f"- cameras, in order: {', '.join(about['cameras'])}",
        *(f"- {key}: {json.dumps(value)}" for key, value in data.items()),
        *(f"- {NAMES.get(part, part.replace('_', ' '))}: {_listed(members)}" for part, members in split.items()),
        *([] if data or split else ["- nothing is recorded: the policy was not trained with ugr-lightning"]),
        "",
        "## Training",
        "",
        f"- {info.step} optimiser steps, {info.epoch + 1} epochs" if info.step else "- not recorded",
        f"- arguments: `{json.dumps(about['blueprint']['init_args'])}`",
        f"- checkpoint: SHA-256 {info.sha256}",
        "",
        "## Success",
        "",
        *(["```", success_table(list(results)), "```"] if results else ["No episode of it has been recorded."]),
        "",
        "## Versions",
        "",
        *(f"- {package} {number}" for package, number in about["versions"].items()),
        "",
        "## Licence",
        "",
        f"The weights: {licence}.",
    ]
    if notes:
        lines += ["", "## Notes", "", *(f"- {note}" for note in notes)]
    return "\n".join(lines) + "\n"


def _listed(members: object) -> str:
    return f"{len(members)}: {', '.join(map(str, members))}" if isinstance(members, list) else str(members)
