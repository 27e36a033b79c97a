"""The command line is frozen: what every command takes is written down in tests/cli/help.

`UGR_WRITE_HELP=1 pytest tests/cli/test_help.py` writes it anew. The files hold what the parsers know, not what they
print, which depends on the width of the terminal and on the versions of Python and jsonargparse.
"""

import contextlib
import os
import re
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

import pytest
from jsonargparse import ArgumentParser

from ugr_lightning.cli.main import COMMANDS, main

FOLDER = Path(__file__).parent / "help"
ONE_OF = {"tasks": ("list", "verify", "seeds"), "data": ("inspect", "convert")}
ONE_OF |= {"bridge": ("robotwin", "xpolicylab", "serve")}
LINES = ["", *(f"{name} {part}".strip() for name in COMMANDS for part in ("", *ONE_OF.get(name, ())))]
LIGHTNINGS = ("trainer.", "optimizer.", "lr_scheduler.", "seed_everything", "verbose")


def in_words(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return " | ".join(map(str, get_args(kind)))
    origin, members = get_origin(kind), [in_words(one) for one in get_args(kind)]
    if origin is None:
        return {type(None): "null", ...: "..."}.get(kind) or kind.__name__
    text = f"{origin.__name__}[{', '.join(members)}]"
    return " | ".join(members) if origin in (Union, UnionType) else text


def options_of(parser: ArgumentParser, nested: bool) -> list[str]:
    found = []
    for action in parser._actions:
        kind = getattr(action, "_typehint", None)
        if kind is None or action.dest.startswith(LIGHTNINGS) or action.dest.endswith(".help"):
            continue
        if "." in action.dest and not nested:
            continue
        default = "" if action.default is None else f" = {action.default}"
        wanted = " (required)" if action.required else ""
        found.append(f"--{action.dest}: {in_words(kind)}{default}{wanted}. {' '.join((action.help or '').split())}")
    return found


def taken(line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    """What a command takes: what it prints by itself, or what its parser knows."""
    parsers: list[ArgumentParser] = []
    monkeypatch.setattr(ArgumentParser, "print_help", lambda self, *_: parsers.append(self))
    with contextlib.suppress(SystemExit):
        main([*line.split(), "--help"])
    printed = capsys.readouterr().out
    if not parsers:
        return printed
    (parser,) = parsers
    options = options_of(parser, nested=line != "validate")  # whose others are those of `ugr fit`
    return "\n".join([f"ugr {line}", *filter(None, (parser.description, parser.epilog)), *options]) + "\n"


@pytest.mark.parametrize("line", LINES)
def test_what_a_command_takes_is_as_it_was(line, monkeypatch, capsys):
    path = FOLDER / f"{line.replace(' ', '_') or 'ugr'}.txt"
    now = taken(line, monkeypatch, capsys)
    if os.environ.get("UGR_WRITE_HELP") == "1":
        path.write_text(now)
    assert now == path.read_text(), f"a change of the command line? `UGR_WRITE_HELP=1 pytest {__file__}` keeps it"


def test_every_command_is_written_down_and_no_other():
    assert {path.stem for path in FOLDER.glob("*.txt")} == {line.replace(" ", "_") or "ugr" for line in LINES}
    for name in ONE_OF:
        listed = re.findall(rf"^  ugr {name} (\w+) ", (FOLDER / f"{name}.txt").read_text(), re.MULTILINE)
        assert tuple(listed) == ONE_OF[name]
