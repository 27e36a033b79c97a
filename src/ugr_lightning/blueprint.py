"""Objects that remember how they were built, so that a checkpoint can rebuild them from plain containers."""

import functools
import importlib
import inspect
from typing import Any

from ugr_lightning.errors import CheckpointError


class Blueprinted:
    """Records the constructor arguments of every subclass as `{"class_path": ..., "init_args": ...}`.

    The form is jsonargparse's, so that a blueprint is also a piece of valid yaml.
    """

    _blueprint: dict[str, Any]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" not in cls.__dict__:
            return
        build = cls.__init__

        @functools.wraps(build)
        def recording_init(self: "Blueprinted", *args: Any, **kwargs: Any) -> None:
            if type(self) is cls:  # a subclass with its own __init__ has already recorded its own arguments
                bound = inspect.signature(build).bind(self, *args, **kwargs)
                bound.apply_defaults()
                given = {name: _plain(value) for name, value in list(bound.arguments.items())[1:]}
                path = f"{cls.__module__}.{cls.__qualname__}"
                object.__setattr__(self, "_blueprint", {"class_path": path, "init_args": given})
            build(self, *args, **kwargs)

        cls.__init__ = recording_init  # type: ignore[assignment]

    def blueprint(self) -> dict[str, Any]:
        """The class and the arguments this object was built with, as plain containers."""
        return self._blueprint


def _plain(value: Any) -> Any:
    if isinstance(value, Blueprinted):
        return value.blueprint()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return str(value)


def rebuild(blueprint: dict[str, Any]) -> Any:
    """Build the object that a blueprint describes.

    Args:
        blueprint: what `Blueprinted.blueprint` returned.

    Raises:
        CheckpointError: the class is not importable, or is not one that records blueprints; only those are ever built,
            so that a foreign checkpoint cannot name an arbitrary callable.
    """
    path = str(blueprint.get("class_path"))
    module, _, name = path.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        fix = f"Install what provides it ({error})."
        raise CheckpointError("class_path", "an importable class", path, fix) from error
    if not (isinstance(found, type) and issubclass(found, Blueprinted)):
        raise CheckpointError("class_path", "a class made for checkpoints", path, "Use a checkpoint from `ugr fit`.")
    return found(**{name: _revive(value) for name, value in blueprint.get("init_args", {}).items()})


def _revive(value: Any) -> Any:
    if isinstance(value, dict) and "class_path" in value:
        return rebuild(value)
    if isinstance(value, dict):
        return {key: _revive(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_revive(item) for item in value]
    return value
