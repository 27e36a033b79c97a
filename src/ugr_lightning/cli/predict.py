"""`ugr predict`: what a checkpoint would have commanded along demonstrations."""

from functools import partial
from pathlib import Path

from ugr_lightning.cli.parsing.call import Count, CountOrZero, call
from ugr_lightning.cli.parsing.data import OWN, open_own
from ugr_lightning.errors import ConfigError


def _predict(
    checkpoint: str = "best",
    run: str | None = None,
    root: str = "runs",
    data: str = OWN,
    episodes: Count = 10,
    tasks: str | list[str] | None = None,
    stride: Count = 5,
    pictures: CountOrZero = 2,
    out: str | None = None,
) -> int:
    """Say how far a policy's commands are from those of demonstrations, where it was trained and where it was not.

    Needs no simulator and no robot, and works for every policy and every format of demonstrations.

    Args:
        checkpoint: `best`, `best_loss`, `last`, or a checkpoint file.
        run: name or folder of a run; null takes the newest run.
        root: folder of all runs.
        data: folder of the recordings that the policy was trained on, `data.root`, or `data.folder` if it had one;
            `own` is what `config.yaml` beside the checkpoint names.
        episodes: how many training and how many validation episodes, at most; the first of its own split.
        tasks: only episodes of these tasks, by name or by pattern (`click_*`), of a policy that was trained on several.
        stride: control steps between two queries.
        pictures: how many episodes of both are pictured.
        out: folder for the page, its numbers and pictures; null means `predictions-<checkpoint>` beside the checkpoint.
    """
    from ugr_lightning.models.checkpoint import load_policy
    from ugr_lightning.results.tables import as_text
    from ugr_lightning.training.runs import resolve_checkpoint
    from ugr_lightning.uncertainty import open_loop as kit
    from ugr_lightning.uncertainty.study import write_page

    file = resolve_checkpoint(checkpoint, run, root)
    policy, info = load_policy(file)
    opened = open_own(policy, info, data)
    fast, split = policy.for_inference(), opened.episode_split
    meant = opened.positions_of(tasks or ())
    chosen_of = {"training": split.train, "validation": split.validation}
    parts = {name: tuple(one for one in part if one in meant)[:episodes] for name, part in chosen_of.items()}
    if not all(parts.values()):
        got = ", ".join(f"{len(part)} {name}" for name, part in parts.items())
        raise ConfigError("--tasks", "tasks with training and validation episodes", got, "Choose more tasks.")
    followed = {name: kit.follow(fast, opened, chosen, stride=stride) for name, chosen in parts.items()}
    std = opened.statistics.action_std.numpy()  # (A,)
    errors = kit.compare_parts(followed["training"], followed["validation"], std)
    says = kit.conclusion(errors, (len(parts["training"]), len(parts["validation"])))
    table = kit.error_table(errors, opened.command_names)
    figures = {
        f"{name}-{opened.demonstrations[episode].name}": kit.episode_figure(
            followed[name], opened, episode, f"{opened.demonstrations[episode].name}, {name}"
        )
        for name, chosen in parts.items()
        for episode in chosen[:pictures]
    }
    print(f"checkpoint: {file}\n{as_text(table)}\n\n{says}")
    folder = Path(out) if out else file.with_name(f"predictions-{file.stem}")
    about = {"file": str(file), "sha256": info.sha256, "task": opened.task}
    content = {"checkpoint": about, "stride": stride, "conclusion": says, "errors": errors}
    write_page(folder, "predictions", f"Predictions of {file}", [says], [table], figures, content)
    print(f"numbers and pictures: {folder}")
    return 0


run = partial(call, _predict, leading=["checkpoint"])
