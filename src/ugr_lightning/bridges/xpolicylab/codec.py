"""msgpack with NumPy arrays as plain maps, the form that XPolicyLab's client sends; nothing in it can run code.

An array is the map {nd: true, type: "<f4", kind: "", shape: [...], data: bytes} with keys of bytes, as the package
msgpack-numpy writes it. That package also unpickles arrays of objects; this reader only knows numbers.
"""

import math
import re
from typing import Any

import numpy as np

from ugr_lightning.errors import ProtocolError

BYTES_OF_ENVIRONMENT = 8 * 2**20
"""Of one observation at most; three cameras of 480x640 with depth are 5.5 MB."""
MAX_ITEMS = 4096
"""Of one list or map; vectors and pictures travel as arrays."""
MAX_AXES = 4
NUMBERS = re.compile(r"[<>|=]?[biuf][1248]")
FIX = "Send msgpack maps with numbers, texts and NumPy arrays of numbers."


def pack(message: dict[str, Any]) -> bytes:
    """Encode a message of plain containers and arrays of numbers."""
    import msgpack

    packed: bytes = msgpack.packb(message, default=_array_to_map, use_bin_type=True)
    return packed


def unpack(frame: bytes, most: int = BYTES_OF_ENVIRONMENT) -> dict[str, Any]:
    """Decode a message.

    Args:
        frame: bytes of one websocket message.
        most: bytes that it may have.

    Returns:
        The map; its arrays are read-only views into the frame.

    Raises:
        ProtocolError: not msgpack, too large, not a map, or an array of something else than numbers.
    """
    import msgpack

    if len(frame) > most:
        raise ProtocolError("frame", f"at most {most} bytes", len(frame), "Send smaller pictures, or fewer at once.")
    try:
        message = msgpack.unpackb(
            frame,
            object_hook=_map_to_array,
            ext_hook=_refuse_extension,
            max_array_len=MAX_ITEMS,
            max_map_len=MAX_ITEMS,
        )
    except ProtocolError:
        raise
    except (ValueError, TypeError, OverflowError, RecursionError) as error:  # msgpack's own are ValueErrors
        raise ProtocolError("frame", "msgpack", type(error).__name__, FIX) from error
    if not isinstance(message, dict):
        raise ProtocolError("frame", "a map", type(message).__name__, FIX)
    return message


def _array_to_map(value: Any) -> dict[bytes, Any]:
    if isinstance(value, np.generic):
        value = np.asarray(value)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
        raise TypeError(f"{type(value).__name__} cannot be sent")
    data = np.ascontiguousarray(value).tobytes()
    return {b"nd": True, b"type": value.dtype.str, b"kind": b"", b"shape": list(value.shape), b"data": data}


def _map_to_array(found: dict[Any, Any]) -> Any:
    """An array or a scalar from its map; other maps stay what they are."""
    if b"nd" not in found:
        return found
    kind, data, shape = found.get(b"type"), found.get(b"data"), found.get(b"shape", ())
    if not isinstance(kind, str) or not NUMBERS.fullmatch(kind) or found.get(b"kind", b"") not in (b"", ""):
        raise ProtocolError("array", "a type of numbers, e.g. <f4", str(kind)[:20], FIX)
    sizes = list(shape) if isinstance(shape, (list, tuple)) else [-1]
    if len(sizes) > MAX_AXES or not all(type(n) is int and n >= 0 for n in sizes) or not isinstance(data, bytes):
        raise ProtocolError("array", f"bytes and up to {MAX_AXES} sizes", str(shape)[:40], FIX)
    try:
        dtype = np.dtype(kind)
    except TypeError as error:  # such as f1
        raise ProtocolError("array", "a type of numbers, e.g. <f4", kind, FIX) from error
    if math.prod(sizes) * dtype.itemsize != len(data):
        raise ProtocolError("array", f"{sizes} numbers of {dtype.itemsize} bytes", f"{len(data)} bytes", FIX)
    array = np.frombuffer(data, dtype).reshape(sizes)
    return array if found[b"nd"] is True else array[()]


def _refuse_extension(code: int, data: bytes) -> Any:
    raise ProtocolError("frame", "no msgpack extensions", f"one of type {code}", FIX)
