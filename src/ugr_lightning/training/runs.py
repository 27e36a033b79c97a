"""Runs on disk, `runs/<name>/version_N`, and which checkpoint `best` and `last` mean across processes."""

import difflib
import re
from pathlib import Path

from ugr_lightning.errors import CheckpointError, ConfigError

FILES = {"best": "policy_best.ckpt", "best_loss": "policy_best_loss.ckpt", "last": "last.ckpt"}


def versions_of(folder: Path) -> list[Path]:
    """The runs in a folder, oldest first."""
    found = [
        (int(match[1]), path)
        for path in folder.glob("version_*")
        if (match := re.fullmatch(r"version_(\d+)", path.name))
    ]
    return [path for _, path in sorted(found)]


def run_folder(run: str, root: Path) -> Path:
    """The folder that `--run` means, the same in every command.

    Args:
        run: the name of a run under `root`; or, where it has a `/`, a folder: one that is there, one inside `root`, or
            one whose path begins with `/`, `./`, `../` or `~/`. Other names with a `/` are runs in groups under `root`.
        root: where runs are kept.
    """
    folder = Path(run).expanduser()
    if "/" in run or folder.is_absolute():
        given = folder.is_absolute() or run.startswith(("./", "../"))
        if given or folder.is_dir() or folder.is_relative_to(root.expanduser()):
            return folder
    return root.expanduser() / folder


def home_of(folder: Path) -> Path:
    """The folder of a run, whether it or one of its versions is given."""
    return folder.parent if re.fullmatch(r"version_\d+", folder.name) else folder


def claim_version(home: Path) -> Path:
    """Make the folder of a new version; of several processes that ask at once each gets its own.

    Args:
        home: the run's folder, `<root>/<name>`.

    Raises:
        ConfigError: nothing can be written there.
    """
    while True:
        existing = versions_of(home)
        number = int(existing[-1].name.removeprefix("version_")) + 1 if existing else 0
        try:
            home.mkdir(parents=True, exist_ok=True)
            (home / f"version_{number}").mkdir(parents=True)  # another process may have removed its empty home
        except FileExistsError:
            if home.is_dir():
                continue  # another process was faster
            fix = "Choose another --run, or move the file away."
            raise ConfigError("--run", "the folder of a run", f"{home}, where a file is in the way", fix) from None
        except OSError as error:
            fix = "Correct the permissions, or choose another folder with --trainer.default_root_dir."
            raise ConfigError("--run", f"a folder that can be written to for {home}", error.strerror, fix) from error
        return home / f"version_{number}"


def resolve_checkpoint(which: str, run: str | None, root: str | Path) -> Path:
    """The checkpoint file that a name means.

    Args:
        which: `best` (of the run's monitor), `best_loss`, `last`, or the path of a file or of an exported folder.
        run: see `run_folder`; of a run it is the newest version that has such a file. None means the newest run.
        root: where runs are kept.

    Raises:
        CheckpointError: there is no such file. Nothing is ever trained or scored from fresh weights instead.
    """
    if which not in FILES:
        given = Path(which).expanduser()
        if given.is_file() or (given / "model.safetensors").is_file():
            return given
        fix = f"Give a file, or one of {', '.join(FILES)} with --run."
        raise CheckpointError("--checkpoint", "a checkpoint file", f"{which}, which is not there", fix)
    root = Path(root)
    run = _newest_run(root) if run is None else run
    folder = run_folder(run, root)
    candidates = [folder, *reversed(versions_of(folder))]
    for candidate in candidates:
        if (candidate / FILES[which]).is_file():
            return candidate / FILES[which]
    where = f"--checkpoint {which}"
    expected = f"a file {FILES[which]} of the run `{run}`"
    others = [name for name, file in FILES.items() if any((place / file).is_file() for place in candidates)]
    if others:
        raise CheckpointError(where, expected, f"only {', '.join(others)}", f"Use --checkpoint {others[-1]}.")
    if folder.is_dir() and not any(folder.rglob("*.ckpt")):
        fix = "Nothing of it is saved: train it anew, without --checkpoint."
        raise CheckpointError(where, expected, f"none in {folder}", fix)
    names = sorted(path.name for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
    near = difflib.get_close_matches(run, names, n=3) or names[:5]
    fix = f"Runs there are: {', '.join(near)}; choose one with --run." if near else "Train one first with `ugr fit`."
    got = f"none in {folder}" if folder.is_dir() else f"no run `{run}` under {root}"
    raise CheckpointError(where, expected, got, fix)


def or_best(checkpoint: str | None, run: str | None) -> str | None:
    """What `--checkpoint` means where it may be left out: the best of a run that is named, otherwise none.

    Args:
        checkpoint: as given.
        run: as given.
    """
    return "best" if checkpoint is None and run is not None else checkpoint


def _newest_run(root: Path) -> str:
    """The run that was written to last; `run` where there is none, which then is not found."""
    found = sorted(root.rglob("version_*/*.ckpt"), key=lambda path: path.stat().st_mtime)
    return str(found[-1].parent) if found else "run"
