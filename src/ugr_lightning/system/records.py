"""JSON that anybody may have edited: read for what it says, or refused in words, before its values are used."""

import dataclasses
import json
import sys
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from ugr_lightning.errors import DataError

T = TypeVar("T")
_LARGEST_INT = 2**63 - 1
_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text", NoneType: "null"}


def parse_json(text: str | bytes) -> Any:
    """What a text in JSON says; NaN and infinities are no JSON.

    Args:
        text: the whole of it.

    Raises:
        ValueError: it is none.
    """
    try:
        return json.loads(text, parse_constant=_refuse)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def read_record(kind: type[T], text: str | bytes, where: object, fix: str) -> T:
    """A dataclass from an object in JSON with one entry for each field that has no default.

    Args:
        kind: a dataclass of plain values, mappings and lists of them.
        text: the object.
        where: file and line, for the error.
        fix: what to do, for the error.

    Raises:
        DataError: no JSON, an entry missing or too many, or a value of another type than the field's.
    """
    try:
        entry = parse_json(text)
    except ValueError as error:
        raise DataError(where, "one JSON object", f"something broken ({error})", fix) from error
    return checked_record(kind, entry, where, fix)


def checked_record(kind: type[T], entry: Any, where: object, fix: str) -> T:
    """As `read_record`, from what JSON has said.

    Args:
        kind, where, fix: see `read_record`.
        entry: the object.

    Raises:
        DataError: see `read_record`.
    """
    fields: Any = dataclasses.fields(kind)  # type: ignore[arg-type]
    wanted = {field.name for field in fields}
    needed = {field.name for field in fields if field.default is field.default_factory is dataclasses.MISSING}
    if not isinstance(entry, dict):
        raise DataError(where, "one JSON object", type(entry).__name__, fix)
    if odd := sorted(set(entry) - wanted):
        raise DataError(where, f"the keys {', '.join(sorted(wanted))}", f"also {', '.join(odd)}", fix)
    if missing := sorted(needed - set(entry)):
        raise DataError(where, f"the keys {', '.join(sorted(needed))}", f"no {', '.join(missing)}", fix)
    types = get_type_hints(kind)
    for name, value in entry.items():
        if not _fits(value, types[name]):
            raise DataError(f"{where}, {name}", _in_words(types[name]), f"{value!r}"[:80], fix)
    return kind(**entry)


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number")


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value from JSON is of a type; a whole number is a float, too, and a truth value is no number."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(_fits(value, one) for one in inner)
    if origin is dict:
        return isinstance(value, dict) and all(_fits(one, inner[1]) for one in value.values())
    if origin is list:
        return isinstance(value, list) and all(_fits(one, inner[0]) for one in value)
    if kind is int:
        return type(value) is int and abs(value) <= _LARGEST_INT
    if kind is float:
        return type(value) in (int, float) and abs(value) <= sys.float_info.max
    return isinstance(value, kind)


def _in_words(kind: Any) -> str:
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return " or ".join(map(_in_words, inner))
    if origin is dict:
        return f"an object with values that are {_in_words(inner[1])}"
    return f"a list, each {_in_words(inner[0])}" if origin is list else _WORDS[kind]
