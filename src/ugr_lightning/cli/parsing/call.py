"""A subcommand that is a typed function, or one of several: jsonargparse turns the signature into options."""

import argparse
import difflib
import inspect
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_origin

from jsonargparse import ArgumentParser, Namespace
from jsonargparse.typing import NonNegativeInt, PositiveInt

from ugr_lightning.cli.parsing.config import explain
from ugr_lightning.errors import ConfigError

if TYPE_CHECKING:
    Count = int
    CountOrZero = int
else:
    Count, CountOrZero = PositiveInt, NonNegativeInt


def call(function: Callable[..., int], command: str, argv: Sequence[str], leading: Sequence[str] = ()) -> int:
    """Parse a command line by the signature of a function and call it.

    Args:
        function: its parameters become options; those without a default are required.
        command: name of the subcommand.
        argv: what follows it.
        leading: options that may be given by their place, before any other; the last may be a list.

    Raises:
        ConfigError: an unknown option or a value that does not fit.
    """
    places = " ".join(name.upper() for name in leading)
    parser = ArgumentParser(
        prog=f"ugr {command}",
        description=_summary(function),
        epilog=f"`ugr {command} {places}` works without the names." if leading else None,
        exit_on_error=False,
        allow_abbrev=False,
    )
    parser.add_function_arguments(function, as_group=False, as_positional=False, sub_configs=True)
    parameters = inspect.signature(function).parameters
    for action in parser._actions:
        if action.dest == "checkpoint":  # Lightning's word for it, and one of earlier versions
            parser._option_string_actions |= {"--ckpt_path": action, "--ckpt": action}
        if getattr(action, "_typehint", None) is bool:
            action.nargs, action.const = "?", True  # `--quick` alone means `--quick true`
    if "config" not in parameters:
        parser.add_argument("--config", action="config", help="YAML file with options")
    try:
        words = name_words(argv, leading, {name: one.annotation for name, one in parameters.items()})
        options = parser.instantiate_classes(at_home(parser.parse_args(words)))
    except (argparse.ArgumentError, ValueError) as error:  # the second of a class in a union
        raise explain(error, parser) from None
    return function(**{name: options[name] for name in parameters})


def call_one_of(
    functions: Mapping[str, tuple[Callable[..., int], Sequence[str]]], command: str, argv: Sequence[str]
) -> int:
    """Call the function that the first argument names.

    Args:
        functions: by name, a function and the options of it that may be given by their place.
        command: name of the subcommand.
        argv: what follows it.

    Raises:
        ConfigError: no such function; otherwise as `call`.
    """
    if argv and argv[0] in ("-h", "--help"):
        lines = [f"  ugr {command} {name:<12}{_summary(function)}" for name, (function, _) in functions.items()]
        print("\n".join([f"usage: ugr {command} NAME [options]", *lines, "`--help` behind each lists its options."]))
        raise SystemExit(0)
    if not argv or argv[0] not in functions:
        near = difflib.get_close_matches(argv[0], functions, n=1) if argv else []
        fix = f"Did you mean `ugr {command} {near[0]}`?" if near else f"`ugr {command} --help` explains them."
        raise ConfigError(f"ugr {command}", f"one of {', '.join(functions)}", argv[0] if argv else "nothing", fix)
    function, leading = functions[argv[0]]
    return call(function, f"{command} {argv[0]}", argv[1:], leading)


def at_home(options: Namespace) -> Namespace:
    """Let every value that begins with `~/` mean the user's home, also in a list: a shell does it for `--key ~/x` only.

    Args:
        options: as parsed, from the command line and from files.
    """
    for key, value in options.items(branches=False):
        options[key] = _at_home(value)
    return options


def _at_home(value: Any) -> Any:
    if isinstance(value, Namespace):  # a class with its arguments, in a list of them
        return at_home(value)
    if isinstance(value, list):
        return [_at_home(item) for item in value]
    is_ours = isinstance(value, (str, Path)) and str(value).startswith("~/")
    return os.path.expanduser(value) if is_ours else value


def _summary(function: Callable[..., int]) -> str:
    return (function.__doc__ or "").split("\n", 1)[0]


def name_words(argv: Sequence[str], leading: Sequence[str], types: Mapping[str, Any]) -> list[str]:
    """Give words before the first option the names of options, and let an option that is a list take several words.

    `A B --power 0.9 0.95` is `--source A --target B --power [0.9, 0.95]`.

    Args:
        argv: what follows the subcommand.
        leading: names of the options that may be given by their place.
        types: of all options, by name.
    """
    parts: list[tuple[str, list[str]]] = [("", [])]
    for word in argv:
        if re.match("--?[a-zA-Z]", word):
            parts.append((word, []))
        else:
            parts[-1][1].append(word)
    (_, first), *options = parts
    named = []
    for name in leading:
        count = len(first) if _list_types(types[name]) else 1
        if first:
            named.append((f"--{name}", first[:count]))
        first = first[count:]
    lists = {f"--{name}": kind for name, kind in types.items() if _list_types(kind)}
    gathered = [*first]  # one too many, which the parser refuses
    for option, words in [*named, *options]:
        gathered += [option, *(_gather(words, lists[option]) if option in lists else words)]
    return gathered


def _list_types(kind: Any) -> list[Any]:
    return [one for one in (kind, *get_args(kind)) if get_origin(one) is list]


def _gather(words: list[str], kind: Any) -> list[str]:
    """Words as one list in YAML, unless a single one is a value already."""
    plain = set(get_args(kind)) - {type(None), *_list_types(kind)} if get_origin(kind) is not list else set()
    if not words or (len(words) == 1 and (plain or words[0] == "null" or words[0].startswith("["))):
        return words
    return [json.dumps(words) if list[str] in _list_types(kind) else f"[{', '.join(words)}]"]
