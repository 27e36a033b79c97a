"""A subcommand that is one typed function: jsonargparse turns its signature into options."""

import argparse
import inspect
from collections.abc import Callable, Sequence

from jsonargparse import ArgumentParser

from ugr_lightning.cli.config import explain
from ugr_lightning.errors import UGRError


def call(function: Callable[..., int], command: str, argv: Sequence[str]) -> int:
    """Parse a command line by the signature of a function and call it.

    Args:
        function: its parameters become options; those without a default are required.
        command: name of the subcommand.
        argv: what follows it.

    Raises:
        ConfigError: an unknown option or a value that does not fit.
    """
    summary = (function.__doc__ or "").split("\n", 1)[0]
    parser = ArgumentParser(prog=f"ugr {command}", description=summary, exit_on_error=False, allow_abbrev=False)
    parser.add_function_arguments(function, as_group=False, as_positional=False, sub_configs=True)
    for action in parser._actions:
        if getattr(action, "_typehint", None) is bool:
            action.nargs, action.const = "?", True  # `--quick` alone means `--quick true`
    if "config" not in inspect.signature(function).parameters:
        parser.add_argument("--config", action="config", help="YAML file with options")
    try:
        options = parser.instantiate_classes(parser.parse_args(list(argv)))
    except argparse.ArgumentError as error:
        if isinstance(error.__cause__ or error.__context__, UGRError):
            raise (error.__cause__ or error.__context__) from None  # type: ignore[misc]
        raise explain(error, parser) from None
    given = {name: options[name] for name in inspect.signature(function).parameters}
    return function(**given)


def name_leading(argv: Sequence[str], names: Sequence[str]) -> list[str]:
    """Give the arguments that come before the first option the names of options: `A B --x 1` is `--a A --b B --x 1`.

    Args:
        argv: what follows the subcommand.
        names: of the options, in order.
    """
    count = next((i for i, argument in enumerate(argv) if argument.startswith("-")), len(argv))
    leading = list(argv[: min(count, len(names))])
    named = [part for name, value in zip(names, leading, strict=False) for part in (f"--{name}", value)]
    return named + list(argv[len(leading) :])
