"""JPEG frames of RoboTwin and XPolicyLab: true RGB in memory, red and blue swapped on disk or not.

A JPEG with a comment segment `XPL-RGB1` stores true RGB, as every viewer expects; one without is swapped. The rule
belongs to each picture and not to a file: both kinds may be in one data set.
"""

import io
from collections.abc import Iterable

import numpy as np
import simplejpeg
from PIL import Image

from ugr_lightning.data.storage.frames import MAX_PIXELS

QUALITY = 95
RGB_MARKER = b"XPL-RGB1"
_COMMENT, _SCAN, _WITHOUT_LENGTH = 0xFE, 0xDA, {0x01, *range(0xD0, 0xD9)}  # codes of segments


def encode_jpeg(image: np.ndarray) -> bytes:
    """Encode one frame as RoboTwin does: the RGB array is handed to an encoder that takes it for BGR.

    Args:
        image: (H, W, 3) uint8 RGB.

    Returns:
        JPEG of quality 95, 4:2:0; standard viewers show it with red and blue swapped.
    """
    image = np.ascontiguousarray(image)
    return simplejpeg.encode_jpeg(image, quality=QUALITY, colorspace="BGR", colorsubsampling="420")


def encode_frame(images: Iterable[np.ndarray]) -> tuple[bytes, ...]:
    """Encode the cameras of one control step.

    Args:
        images: V of (H, W, 3) uint8 RGB.
    """
    return tuple(encode_jpeg(image) for image in images)


def stores_rgb(data: bytes) -> bool:
    """Whether a JPEG is marked as true RGB; without the mark it is channel-swapped.

    Only comment segments before the picture count, not the same bytes somewhere else.

    Args:
        data: any bytes; False for what is no JPEG.
    """
    at = 2
    while data[at : at + 1] == b"\xff" and at + 1 < len(data):
        code = data[at + 1]
        if code == 0xFF:  # filling
            at += 1
        elif code in _WITHOUT_LENGTH:
            at += 2
        elif code == _SCAN:
            return False
        else:
            length = int.from_bytes(data[at + 2 : at + 4], "big")
            if code == _COMMENT and data[at + 4 : at + 2 + length] == RGB_MARKER:
                return True
            at += 2 + max(length, 2)
    return False


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Height and width that a JPEG declares.

    Raises:
        ValueError: not a JPEG, or cut off.
    """
    if not (data.startswith(b"\xff\xd8") and data.endswith(b"\xff\xd9")):
        raise ValueError("no JPEG start and end marker")
    height, width, _, _ = simplejpeg.decode_jpeg_header(data)
    return height, width


def decode_picture(data: bytes) -> np.ndarray:
    """Decode a JPEG or PNG of any size to true RGB, by the same rule: without the mark, red and blue are swapped.

    Args:
        data: the encoded picture; zeros behind a JPEG are passed over.

    Returns:
        (H, W, 3) uint8.

    Raises:
        ValueError: no such picture, damaged, or of an absurd size.
    """
    if data.startswith(b"\xff\xd8"):
        data = data.rstrip(b"\0")
        out = np.empty((*_sensible(jpeg_size(data)), 3), np.uint8)
        decode_jpeg(data, out)
        return out
    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as picture:
            _sensible(picture.size)
            return np.asarray(picture.convert("RGB"))[..., ::-1]
    except (OSError, SyntaxError) as error:
        raise ValueError("neither a JPEG nor a PNG") from error


def _sensible(size: tuple[int, int]) -> tuple[int, int]:
    if not 0 < min(size) <= max(size) <= MAX_PIXELS:
        raise ValueError(f"a picture of {size}")
    return size


def decode_jpeg(data: bytes, out: np.ndarray) -> None:
    """Decode one stored frame to true RGB.

    Args:
        data: JPEG from a demonstration file, marked as true RGB or channel-swapped.
        out: (H, W, 3) uint8, contiguous; receives the picture.

    Raises:
        ValueError: damaged, or not of the size of `out`.
    """
    colorspace = "RGB" if stores_rgb(data) else "BGR"
    if jpeg_size(data) != out.shape[:2]:
        raise ValueError(f"a picture of {jpeg_size(data)}, not {out.shape[:2]}")
    simplejpeg.decode_jpeg(data, colorspace=colorspace, buffer=out)
