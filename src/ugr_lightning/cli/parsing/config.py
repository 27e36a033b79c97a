"""Configuration files of the command line: `include`, the name of a run, and errors that name the key."""

import difflib
import importlib
import inspect
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from jsonargparse import ArgumentParser

from ugr_lightning.errors import ConfigError, UGRError
from ugr_lightning.system.workers import describe_error


def expand_includes(argv: Sequence[str]) -> list[str]:
    """Put the files that a `--config` file includes before it, so that the file only states what differs.

    Args:
        argv: command line; `include: other.yaml` (or a list) at the top of a config is relative to that config.

    Returns:
        The command line with one `--config` per file, in the order in which they override each other.

    Raises:
        ConfigError: a config or an included file is missing or is not a YAML mapping, or files include each other.
    """
    expanded: list[str] = []
    arguments = iter(argv)
    for argument in arguments:
        flag, _, value = argument.partition("=")
        if flag not in ("--config", "-c"):
            expanded.append(argument)
            continue
        value = value or next(arguments, "")
        for path in _with_includes(find_config(value, "--config"), ()):
            expanded += ["--config", str(path)]
    return expanded


def config_names() -> dict[str, Path]:
    """The configs that ship with the package, by name: `uncert`, `task/compact/handover_block`."""
    package = Path(__file__).parents[2]
    inside = package / "configs"  # in a wheel; a checkout has the folder at its top
    folder = inside if inside.is_dir() else package.parents[1] / "configs"
    return {str(path.relative_to(folder).with_suffix("")): path for path in sorted(folder.rglob("*.yaml"))}


def find_config(name: str | Path, where: object, beside: Path = Path(), under: str = "") -> Path:
    """A config by its path, or by its name among those that ship with the package.

    Args:
        name: `my.yaml`, `../compact.yaml`, `uncert`, `task/compact/handover_block`.
        where: what names it, for the error.
        beside: folder that a path is relative to.
        under: folder of the shipped ones that the name may leave out, such as `benchmark`.

    Raises:
        ConfigError: neither; lists near names, or all of them.
    """
    path, named = beside / Path(name).expanduser(), config_names()
    plain = str(name).removesuffix(".yaml")
    for candidate in (path, named.get(plain, path), named.get(f"{under}/{plain}", path)):
        if candidate.is_file():
            return candidate
    files = [file.name for file in path.parent.glob("*.yaml")] if path.parent.is_dir() else []
    near = difflib.get_close_matches(path.name, files, n=3) or difflib.get_close_matches(plain, named, n=3)
    near = near or [other for other in named if other.rpartition("/")[2] == path.stem]
    fix = f"Did you mean {_either(near)}?" if near else f"Names are {', '.join(named)}; or give the path of a file."
    raise ConfigError(where, "a config file or name", f"{name}, which is not there", fix)


def _with_includes(path: Path, parents: tuple[Path, ...]) -> Iterator[Path]:
    if path.resolve() in parents:
        chain = " -> ".join(p.name for p in (*parents, path))
        raise ConfigError(path, "configs that do not include each other", chain, "Remove one of the `include` lines.")
    for included in _includes(path):
        found = find_config(included, f"`include` in {path}", path.parent)
        yield from _with_includes(found, (*parents, path.resolve()))
    yield path


def _includes(path: Path) -> list[str]:
    try:
        content = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(path, "valid YAML", " ".join(str(error).split()), "Correct the file.") from error
    if content is None:
        return []
    if not isinstance(content, dict):
        raise ConfigError(path, "a mapping of keys to values", type(content).__name__, "Correct the file.")
    given = content.get("include") or []
    included = [given] if isinstance(given, str) else given
    if not isinstance(included, list) or not all(isinstance(name, str) for name in included):
        raise ConfigError(f"`include` in {path}", "a name or path, or a list of them", given, "Correct the file.")
    return included


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of nested mappings by dotted key."""
    values: dict[str, Any] = {}
    for name, value in tree.items():
        values |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return values


def config_of(key: str, argv: Sequence[str]) -> str | None:
    """The config that a value is from; None where the command line itself has it, or nothing has.

    Args:
        key: dotted, such as `data.folder`.
        argv: command line, includes expanded.
    """
    found = None
    for flag, value in pairwise([*argv, ""]):
        if flag == "--config" and key in flat(yaml.safe_load(Path(value).read_text()) or {}):
            found = value
        elif flag.partition("=")[0] == f"--{key}":
            found = None
    return found


def run_name(argv: Sequence[str]) -> str:
    """The name of a run when none is given: the names of its configs, e.g. `uncert-handover_block`.

    Args:
        argv: command line before includes are expanded.
    """
    names = []
    for position, argument in enumerate(argv):
        flag, _, value = argument.partition("=")
        if flag in ("--config", "-c"):
            path = Path(value or (argv[position + 1] if position + 1 < len(argv) else "run"))
            names.append(f"paper-{path.stem}" if path.parent.name == "paper" else path.stem)
    return "-".join(names) or "run"


def explain(error: Exception, parser: ArgumentParser | None, argv: Sequence[str] = ()) -> UGRError:
    """Turn a parser's error into one paragraph that names the key and what was probably meant.

    Args:
        error: what the parser raised; where that was because a class refused its arguments in our words, these hold.
        parser: the parser of the subcommand, for the keys it knows.
        argv: command line, includes expanded, for the configs that were given.
    """
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, UGRError):
            return cause
        cause = cause.__cause__ or cause.__context__
    message = " ".join(str(error).split())
    required = re.search(r"arguments are required: ([\w., ]+)", message)
    if required:
        wanted = ", ".join(f"--{name}" for name in required[1].split(", "))
        return ConfigError("command line", wanted, "a command without", "Add it; `--help` explains.")
    unknown = re.findall(r"[Kk]ey '?\"?([\w.\-]+)'?\"? is not expected", message)
    unknown += re.findall(r"(?:[Nn]o action for key|Nested key|[Oo]ption) '?\"?([\w.\-]+)'?\"?", message)
    words = re.findall(r"[Uu]nrecognized arguments: (\S+)", message)
    if words and not words[0].startswith("-"):
        fix = f"Write `--NAME {words[0]}`; `--help` lists the names."
        return ConfigError("command line", "the name of an option before its value", f"the word {words[0]}", fix)
    unknown += [word.lstrip("-").split("=")[0] for word in words]
    if not unknown:
        keys = re.findall(r"[Kk]ey \"([\w.\-]+)\": ", message)
        told = message.rpartition(f'"{keys[-1]}": ')[2] if keys else message
        if "Subtypes" not in told:  # behind it comes what a union around this key could be as well
            told = re.split(r"(?<=\S) - Expected", told)[0]
        where = ".".join(keys) or "configuration"
        return ConfigError(where, *(_refused_class(told, error) or (*_wanted(told), "Correct the value.")))
    key = unknown[-1]
    known = set(_known_keys(parser, message))
    near = difflib.get_close_matches(key, known, n=3) or difflib.get_close_matches(
        key.rpartition(".")[2], {k.rpartition(".")[2] for k in known}, n=3
    )
    fix = f"Did you mean {_either(near)}?" if near else "`--help` and `--print_config` list the keys."
    fix = _written_before(key, argv) or _overlay_for_another(key, argv) or fix
    return ConfigError(key, "a known key", "an unknown one" + _context(message, key), fix)


def _written_before(key: str, argv: Sequence[str]) -> str | None:
    """What to delete from the config of an older run, which has keys that are gone; None where this is none of them."""
    for path in (Path(value) for flag, value in pairwise(argv) if flag == "--config"):
        content = flat(yaml.safe_load(path.read_text()) or {})
        policy = _imported(str(content.get("model.policy.class_path", "")))
        gone = {"on_missing_renderer": "warn", **getattr(policy, "retired", {})}
        there = [one for one in content if one.rpartition(".")[2] in gone]
        if key.rpartition(".")[2] in gone and there:
            means = ", ".join(f"{one.rpartition('.')[2]} {gone[one.rpartition('.')[2]]}" for one in there)
            return f"An older version wrote {path}: delete these keys there, they cannot be chosen any more ({means})."
    return None


def _overlay_for_another(key: str, argv: Sequence[str]) -> str | None:
    """Which config to give in place of one that sets a key for another policy: one beside it, named as one given."""
    given = [Path(value) for flag, value in pairwise(argv) if flag == "--config"]
    names = {path.resolve(): name for name, path in config_names().items()}
    for path in given:
        keys = {one.rpartition(".")[2] for one in flat(yaml.safe_load(path.read_text()) or {})}
        for other in given if key.rpartition(".")[2] in keys else ():
            meant = path.with_name(other.name)
            if meant.is_file() and meant not in given:
                ours, theirs = (names.get(one.resolve(), one) for one in (meant, path))
                return f"`{theirs}` sets it: did you mean `--config {ours}`?"
    return None


_NAMED = (
    r"(?:Expected a path but |class_path '|Import path (?=\S+ does)"
    r"|Given value: (?:\{'class_path': '|Namespace\(class_path=')?)([\w.]+)"
)


def _refused_class(told: str, error: BaseException) -> tuple[str, str, str] | None:
    """Expected, got and advice where a key takes an object and what was named is no such class; None for other keys."""
    union = re.search(r"Subtypes: \[(.*?)\] Errors: ", told)
    choices = [_imported(path) for path in re.findall(r"<class '([\w.]+\.\w+)'>", union[1])] if union else []
    choices = [kind for kind in choices if isinstance(kind, type) and not issubclass(kind, (Path, int, float, str))]
    settings = [field.name for kind in choices if is_dataclass(kind) for field in fields(kind)]
    kinds = [kind.__name__ for kind in choices if not is_dataclass(kind)]
    if union is None:
        kinds = re.findall(r"subclass of (\w+)", told)
    named = re.search(_NAMED, told)
    if named is not None and settings and not kinds:
        return f"a mapping of {', '.join(settings)}, or null", named[1], "`--print_config` shows one."
    if named is None or not (kinds or (union is None and "class_path" in told)):
        return None
    path = named[1]
    module, _, name = path.rpartition(".")
    expected = " or ".join(f"the path of a {kind}" for kind in kinds or ["class"])
    expected += " or null" if union and "NoneType" in union[1] else ""
    found = _imported(path)
    if not module:
        return expected, path, "Write `package.module.Class`."
    if isinstance(found, ModuleNotFoundError) and f"{module}.".startswith(f"{found.name}."):
        fix = "Correct it; modules are found in the folder in which `ugr` runs, and on PYTHONPATH."
        return expected, f"{path}, and there is no module {found.name}", fix
    if isinstance(found, AttributeError) and module in sys.modules:
        near = difflib.get_close_matches(name, vars(sys.modules[module]), n=3)
        fix = f"Did you mean {_either(near)}?" if near else "Correct the name."
        return expected, f"{path}, and {module} has no {name}", fix
    if isinstance(found, Exception):
        return expected, f"{path}, which cannot be imported: {describe_error(found)}", "Correct the file."
    if "does not correspond to a subclass" in told or not isinstance(found, type):
        return expected, f"{path}, which is not derived from it", "Derive it, or name another class."
    if inspect.isabstract(found):
        lacking = ", ".join(sorted(getattr(found, "__abstractmethods__", ())))
        return expected, f"{path}, which does not define {lacking}", "Define what is missing."
    while error.__cause__ is not None:
        error = error.__cause__
    got = describe_error(error) if isinstance(error, Exception) else str(error)
    return expected, f"{path}, which refused: {got}", "Correct the class, or what it is given."


def _imported(path: str) -> Any:
    """What a dotted path names, or the exception that says why there is nothing."""
    module, _, name = path.rpartition(".")
    try:
        return getattr(importlib.import_module(module), name)
    except Exception as error:  # whatever a user's file raises
        return error


_IN_WORDS = {
    "PositiveInt": "a whole number above 0",
    "NonNegativeInt": "a whole number, 0 or more",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "str": "text",
    "dict": "a mapping",
    "list": "a list",
    "tuple": "a list",
    "set": "a list",
    "NoneType": "null",
}
_KIND = r"(?:Expected an?|Not of type) (?:typing\.Literal\[(.*?)\]|<class '(\w+)'>|(\w+Int)\b|(tuple .*? elements))"
_VALUE = r"(?:Got value|Given value|int\(\) with base 10|Int(?=: -?\d)): (.*?)(?=\.?$| - Expected| does not conform)"


def _wanted(told: str) -> tuple[str, str]:
    """What the types of a key accept, and the value that none of them does, in words where jsonargparse names both."""
    choices: dict[str, None] = {}  # in order, each once
    for words, kind, number, several in re.findall(_KIND, told):
        wanted = _IN_WORDS.get(kind + number) or f"a {several or kind or number}"
        choices |= dict.fromkeys(re.findall("'(.*?)'", words) or [wanted])
    values = re.findall(_VALUE, told)
    if not choices or not values:
        return "a value that the key accepts", told[:600].rstrip(".")
    *others, last = choices
    return f"{', '.join(others)} or {last}" if others else last, values[0].strip("'")


def _context(message: str, key: str) -> str:
    """The class in whose arguments the key was found, where the message tells."""
    paths = re.findall(r"class_path['\" :]+([\w.]+\.[\w.]+)", message)
    return f" among the arguments of {paths[-1]}" if paths and "." not in key else ""


def _known_keys(parser: ArgumentParser | None, message: str) -> Iterator[str]:
    if parser is not None:
        yield from (action.dest for action in parser._actions if action.dest)
    for path in re.findall(r"\bugr_lightning(?:\.\w+)+|(?<=class_path ')[\w.]+", message):
        with suppress(TypeError, ValueError):  # the message named something that is no class
            yield from inspect.signature(_imported(path)).parameters


def _either(names: Sequence[str]) -> str:
    return " or ".join(f"`{name}`" for name in names)
