"""Objects that remember how they were built, so that a checkpoint can rebuild them from plain containers."""

import functools
import importlib
import inspect
import types
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from numbers import Integral, Real
from pathlib import Path
from typing import Any, ClassVar, Union, get_args, get_origin, get_type_hints

from ugr_lightning.errors import CheckpointError, ConfigError, UGRError


class Blueprinted:
    """Records the constructor arguments of every subclass as `{"class_path": ..., "init_args": ...}`.

    The form is jsonargparse's, so that a blueprint is also a piece of valid yaml. Arguments are numbers, text, paths,
    other objects that record themselves, lists and mappings of these, and dataclasses that the constructor's type hints
    name; anything else is refused when the object is built.
    """

    not_kept: ClassVar[tuple[str, ...]] = ()
    """Arguments that are recorded as null, because the object's weights replace what they name."""
    retired: ClassVar[Mapping[str, object]] = {}
    """Arguments that the class no longer has, in blueprints of before, with the values that are now always meant."""
    _blueprint: dict[str, Any]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        build = cls.__init__
        if hasattr(build, "records_arguments"):  # inherited: the first that is called records for every subclass
            return

        @functools.wraps(build)
        def recording_init(self: "Blueprinted", *args: Any, **kwargs: Any) -> None:
            if "_blueprint" not in self.__dict__:
                object.__setattr__(self, "_blueprint", _record(type(self), build, (self, *args), kwargs))
            build(self, *args, **kwargs)

        recording_init.records_arguments = True  # type: ignore[attr-defined]
        cls.__init__ = recording_init  # type: ignore[assignment]

    def blueprint(self) -> dict[str, Any]:
        """The class and the arguments this object was built with, as plain containers."""
        given = self._blueprint["init_args"]
        return {
            **self._blueprint,
            "init_args": {name: None if name in self.not_kept else value for name, value in given.items()},
        }


def _record(kind: type, build: Callable[..., None], args: tuple[Any, ...], kwargs: dict[str, Any]) -> dict[str, Any]:
    """The blueprint of an object of a class that is built with these arguments."""
    path = f"{kind.__module__}.{kind.__qualname__}"
    if "<locals>" in path:
        fix = "Define it at the top level of a module; a class inside a function cannot be found again."
        raise ConfigError(path, "a class that a checkpoint can name", "one inside a function", fix)
    bound = inspect.signature(build).bind(*args, **kwargs)
    bound.apply_defaults()
    given = dict(list(bound.arguments.items())[1:])
    for parameter in inspect.signature(build).parameters.values():
        if parameter.kind is parameter.VAR_POSITIONAL and given.pop(parameter.name, ()):
            fix = "Give them by name; a checkpoint records arguments by their names."
            raise ConfigError(path, "arguments with names", f"some in *{parameter.name}", fix)
        if parameter.kind is parameter.VAR_KEYWORD:
            given |= given.pop(parameter.name, {})
    hints = _hints(kind)
    recorded = {name: _plain(value, hints.get(name), f"{path}.{name}") for name, value in given.items()}
    return {"class_path": path, "init_args": recorded}


def _plain(value: Any, hint: Any, where: str) -> Any:
    """A value as plain containers, if `_revive` makes the same of them with that type hint."""
    if isinstance(value, Blueprinted):
        return value.blueprint()
    if isinstance(value, (list, tuple)):
        inner = _inner(hint)
        return [_plain(item, inner, where) for item in value]
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        inner = _inner(hint)
        return {str(key): _plain(item, inner, f"{where}.{key}") for key, item in value.items()}
    if is_dataclass(value) and type(value) in _choices(hint):
        hints = _hints(type(value))
        given = {field.name: getattr(value, field.name) for field in fields(value) if field.init}
        return {name: _plain(item, hints.get(name), f"{where}.{name}") for name, item in given.items()}
    if isinstance(value, Path) and Path in _choices(hint):
        return str(value)
    if value is None or isinstance(value, bool):
        return value
    plain: tuple[tuple[Any, Any], ...] = ((Integral, int), (Real, float), (str, str))
    for kind, make in plain:
        if isinstance(value, kind) and not isinstance(value, Enum):
            return make(value)  # a NumPy scalar becomes a number
    fix = (
        "Give its settings and build it in `__init__`, or derive its class from `ugr_lightning.blueprint.Blueprinted`."
    )
    if is_dataclass(value):
        fix = "Name the dataclass in the type hint of the argument, so that it can be rebuilt."
    expected = "an argument that a checkpoint can record: numbers, text, lists, mappings, annotated dataclasses"
    raise ConfigError(where, expected, type(value).__qualname__, fix)


def rebuild(blueprint: dict[str, Any]) -> Any:
    """Build the object that a blueprint describes.

    Args:
        blueprint: what `Blueprinted.blueprint` returned.

    Raises:
        CheckpointError: the class is not importable, cannot be built with the arguments, or is not one that records
            blueprints; only those are ever built, so that a foreign checkpoint cannot name an arbitrary callable.
    """
    path = str(blueprint.get("class_path"))
    module, _, name = path.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        fix = f"Install what provides it, or put its folder on PYTHONPATH ({error})."
        if module == "__main__":
            fix = "It was defined in a script or a notebook: move it to a module, and train with that."
        raise CheckpointError("class_path", "an importable class", path, fix) from error
    if not (isinstance(found, type) and issubclass(found, Blueprinted)):
        raise CheckpointError("class_path", "a class made for checkpoints", path, "Use a checkpoint from `ugr fit`.")
    hints = _hints(found)
    try:
        given = {name: _revive(value, hints.get(name)) for name, value in blueprint.get("init_args", {}).items()}
        _drop_retired(found, given)
        _check_arguments(found, given)
        return found(**given)
    except (UGRError, MemoryError):  # neither says anything about the arguments
        raise
    except Exception as error:  # whatever a constructor makes of arguments that were meant for another one
        fix = "The class has changed since, or the checkpoint is damaged."
        got = f"{type(error).__name__}: {error}"
        raise CheckpointError("init_args", f"arguments that {path} can be built with", got, fix) from error


def _drop_retired(kind: type[Blueprinted], given: dict[str, Any]) -> None:
    """Take away what an older version of a class was given, where it asks for nothing else than is done now."""
    for name, value in kind.retired.items():
        got = given.pop(name, value)
        if got != value:
            fix = "What it asks for is no longer in the code: use the version that wrote the checkpoint."
            raise CheckpointError(f"{kind.__module__}.{kind.__qualname__}.{name}", value, got, fix)


def _check_arguments(kind: type, given: dict[str, Any]) -> None:
    try:
        inspect.signature(kind).bind(**given)
    except TypeError as error:
        fix = "The checkpoint is of another version of that class."
        expected = f"arguments that {kind.__module__}.{kind.__qualname__} has"
        raise CheckpointError("init_args", expected, str(error).removeprefix("got "), fix) from error


def _revive(value: Any, hint: Any) -> Any:
    """What `_plain` made plain, by the same type hint."""
    if isinstance(value, dict) and "class_path" in value:
        return rebuild(value)
    if isinstance(value, dict):
        for kind in _choices(hint):
            if isinstance(kind, type) and is_dataclass(kind):
                hints = _hints(kind)
                given = {name: _revive(item, hints.get(name)) for name, item in value.items()}
                _check_arguments(kind, given)
                return kind(**given)
        return {key: _revive(item, _inner(hint)) for key, item in value.items()}
    if isinstance(value, list):
        items = [_revive(item, _inner(hint)) for item in value]
        return tuple(items) if any(get_origin(kind) is tuple for kind in _choices(hint)) else items
    return Path(value) if isinstance(value, str) and Path in _choices(hint) else value


def _hints(kind: type) -> dict[str, Any]:
    """Type hints of a class's constructor and, behind its `**kwargs`, of those that it inherits from."""
    hints: dict[str, Any] = {}
    for ancestor in kind.__mro__:
        if "__init__" in ancestor.__dict__ and ancestor is not object:
            try:
                found = get_type_hints(inspect.unwrap(ancestor.__dict__["__init__"]))
            except (NameError, TypeError):  # names that exist for type checkers alone
                continue
            hints = {**found, **hints}
    return hints


def _choices(hint: Any) -> Iterator[Any]:
    """The types of which a hint allows one."""
    if get_origin(hint) in (Union, types.UnionType):
        for choice in get_args(hint):
            yield from _choices(choice)
    elif hint is not None:
        yield hint


def _inner(hint: Any) -> Any:
    """The type of the items of a list or mapping with that hint, None where it does not say."""
    inner = [args[-1 if args[-1] is not Ellipsis else 0] for kind in _choices(hint) if (args := get_args(kind))]
    return Union[tuple(inner)] if inner else None  # noqa: UP007 - made of types at run time
