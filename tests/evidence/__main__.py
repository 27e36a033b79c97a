"""`make evidence`: what the package does when things go wrong, tried, and a table of it.

Each trial that has passed is noted in `build/evidence/trials.jsonl`; the same command goes on with those that are left.
"""

import argparse
import fnmatch
import json
import os
import shutil
import sys
import textwrap
import time
import warnings
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "stand_ins"))

import torch
from disturbances import PIECES
from jobs import write_tasks
from trial import NotHereError, Piece

import ugr_lightning.cli.collect
import ugr_lightning.cli.fit
import ugr_lightning.cli.rollout  # noqa: F401  commands are forked: they find all of this imported

HEADING = """# When things go wrong

Made by `make evidence`, which goes on where it was stopped; `make evidence ARGS="--only 'killed/*'"` runs a part. Every
trial has a number that seeds its choices, such as the moment of a kill; they are in `build/evidence/trials.jsonl`.
Recordings and evaluations are those of a simulator without physics, trainings those of a policy of a few numbers: what
is tried is what is written, and when. [Going on with a training](../resume.md) says what to expect. {}.

| what is done | what has to come out | it did | said | minutes |
|---|---|---|---|---|
"""


def run(piece: Piece, work: Path, notes: list[dict[str, Any]], file: Path) -> None:
    """Carry out the trials of a piece that have not passed yet."""
    passed = {note["trial"] for note in notes if note["piece"] == piece.name and note["held"] is True}
    for number in (number for number in range(piece.count) if number not in passed):
        folder = work / piece.name / str(number)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)  # there if a trial that was killed has left a disk mounted on it
        start, held = time.monotonic(), True
        try:
            said = piece.trial(folder, number)
        except NotHereError as reason:
            held, said = None, str(reason)
        except AssertionError as error:
            held, said = False, str(error)
        seconds = round(time.monotonic() - start, 1)
        note = {"piece": piece.name, "trial": number, "held": held, "said": said, "seconds": seconds}
        notes.append(note)
        with file.open("a") as lines:
            lines.write(json.dumps(note) + "\n")
        print(f"{piece.name} {number}: {({True: 'held', None: 'not here'}).get(held, 'FAILED')}, {seconds} s, {said}")
        if held:
            shutil.rmtree(folder, ignore_errors=True)


def page(notes: list[dict[str, Any]]) -> str:
    """The table: the newest outcome of each trial."""
    rows = []
    for piece in PIECES:
        last = {note["trial"]: note for note in notes if note["piece"] == piece.name}
        held = sum(note["held"] is True for note in last.values())
        if not last:
            outcome, said = "not tried", ""
        elif all(note["held"] is None for note in last.values()):
            outcome, said = "not possible here", last[0]["said"]
        else:
            outcome, said = f"{held} of {len(last)}", str(last[min(last)]["said"])
        minutes = sum(note["seconds"] for note in last.values()) / 60
        said = textwrap.shorten(said.replace("|", "/"), 120, placeholder=" ...")
        rows.append(f"| {piece.does} | {piece.holds} | {outcome} | {said} | {minutes:.1f} |")
    whole = {(note["piece"], note["trial"]): note["seconds"] for note in notes}
    return HEADING.format(f"{len(whole)} trials in {sum(whole.values()) / 60:.0f} minutes") + "\n".join(rows) + "\n"


def main() -> int:
    """Run what is left and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", action="append", default=[], help="names of pieces, or patterns such as 'killed/*'")
    parser.add_argument("--work", type=Path, default=Path("build/evidence"), help="where trials run and are noted")
    parser.add_argument("--page", type=Path, help="where the table goes, `evidence.md` in that folder by default")
    parser.add_argument("--list", action="store_true", help="the pieces' names")
    options = parser.parse_args()
    if options.list:
        print("\n".join(f"{piece.name}: {piece.does}" for piece in PIECES))
        return 0
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    work = options.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    write_tasks(work / "tasks")
    file = work / "trials.jsonl"
    notes = [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []
    chosen = [p for p in PIECES if not options.only or any(fnmatch.fnmatch(p.name, one) for one in options.only)]
    for piece in chosen:
        run(piece, work, notes, file)
        (options.page or work / "evidence.md").write_text(page(notes))
    failed = [note for note in notes if note["held"] is False]
    return int(any(note == last_of(notes, note) for note in failed))


def last_of(notes: list[dict[str, Any]], note: dict[str, Any]) -> dict[str, Any]:
    """The newest note on the same trial."""
    return [one for one in notes if (one["piece"], one["trial"]) == (note["piece"], note["trial"])][-1]


if __name__ == "__main__":
    sys.exit(main())
