"""JPEG frames in RoboTwin's colour order (FACTS 1.4): true RGB in memory, red and blue swapped on disk."""

import numpy as np
import simplejpeg

QUALITY = 95
RGB_MARKER = b"XPL-RGB1"  # comment segment of files whose JPEG stores true RGB
COMMENT = b"\xff\xfe"


def encode_jpeg(image: np.ndarray) -> bytes:
    """Encode one frame as RoboTwin does: the RGB array is handed to an encoder that takes it for BGR.

    Args:
        image: (H, W, 3) uint8 RGB.

    Returns:
        JPEG of quality 95, 4:2:0; standard viewers show it with red and blue swapped.
    """
    image = np.ascontiguousarray(image)
    return simplejpeg.encode_jpeg(image, quality=QUALITY, colorspace="BGR", colorsubsampling="420")


def encode_frame(images: np.ndarray) -> tuple[bytes, ...]:
    """Encode the cameras of one control step.

    Args:
        images: (V, H, W, 3) uint8 RGB.
    """
    return tuple(encode_jpeg(image) for image in images)


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Height and width that a JPEG declares.

    Raises:
        ValueError: not a JPEG, or cut off.
    """
    if not (data.startswith(b"\xff\xd8") and data.endswith(b"\xff\xd9")):
        raise ValueError("no JPEG start and end marker")
    height, width, _, _ = simplejpeg.decode_jpeg_header(data)
    return height, width


def decode_jpeg(data: bytes, out: np.ndarray) -> None:
    """Decode one stored frame to true RGB.

    Args:
        data: JPEG from a demonstration file; a comment segment `XPL-RGB1` marks one that is not channel-swapped.
        out: (H, W, 3) uint8, contiguous; receives the picture.

    Raises:
        ValueError: damaged, or not of the size of `out`.
    """
    colorspace = "RGB" if COMMENT + len(RGB_MARKER + b"..").to_bytes(2, "big") + RGB_MARKER in data else "BGR"
    if jpeg_size(data) != out.shape[:2]:
        raise ValueError(f"a picture of {jpeg_size(data)}, not {out.shape[:2]}")
    simplejpeg.decode_jpeg(data, colorspace=colorspace, buffer=out)
