"""Pictures in HDF5 files: plain numbers, or JPEGs in rows of bytes; checked once, then read a step at a time."""

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ugr_lightning.data.storage.frames import MAX_PIXELS, FrameSource, SeveralSources
from ugr_lightning.data.storage.hdf5 import FIX, MAX_ROW_BYTES, find_dataset, has_key
from ugr_lightning.data.storage.jpeg import decode_jpeg, jpeg_size
from ugr_lightning.errors import DataError

MAX_ROWS = 64  # that are read at once
CHOOSE = "Leave it out: choose cameras with colour pictures (`--cameras`, or the policy's `cameras`)."


class Hdf5Frames(FrameSource):
    """Frames in an HDF5 file, one dataset per camera.

    The file is opened at the first read in each process: an HDF5 handle survives neither a fork nor pickling.

    Args:
        path: the file.
        keys: one dataset per camera.
        image_size: (height, width) that every frame has.
    """

    def __init__(self, path: Path, keys: tuple[str, ...], image_size: tuple[int, int]) -> None:
        self.path, self.keys, self.image_size = path, keys, image_size
        self._opened: tuple[int, h5py.File, dict[str, h5py.Dataset]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None}

    @property
    def files(self) -> tuple[Path, ...]:
        return (self.path,)

    def _dataset(self, key: str) -> h5py.Dataset:
        if self._opened is None or self._opened[0] != os.getpid():
            self._opened = (os.getpid(), h5py.File(self.path, "r"), {})
        _, file, datasets = self._opened
        if key not in datasets:
            datasets[key] = file[key]
        return datasets[key]

    def close(self) -> None:
        if self._opened is not None and self._opened[0] == os.getpid():
            self._opened[1].close()
        self._opened = None

    def _rows(self, step: int, keys: Sequence[str]) -> list[Any]:
        """What some datasets hold for one step."""
        try:
            return [self._dataset(key)[step] for key in keys]
        except (OSError, RuntimeError, KeyError, ValueError, IndexError) as error:
            raise DataError(f"{self.path}[{step}]", "a stored frame", f"a read error ({error})", FIX) from error


class JpegFrames(Hdf5Frames):
    """JPEG frames in an HDF5 file, one dataset per camera: bytes, or rows of bytes with zeros behind."""

    def jpegs(self, step: int) -> tuple[bytes, ...]:
        """The stored bytes."""
        return tuple(_jpeg(row) for row in self._rows(step, self.keys))

    def read(self, step: int, out: np.ndarray) -> None:
        for key, data, picture in zip(self.keys, self.jpegs(step), out, strict=True):
            try:
                decode_jpeg(data, picture)
            except ValueError as error:
                size = "x".join(map(str, self.image_size))
                raise DataError(f"{self.path}:{key}[{step}]", f"a JPEG of {size}", str(error), FIX) from error


class RawFrames(Hdf5Frames):
    """RGB frames as plain numbers in an HDF5 file, one dataset (T, H, W, 3) uint8 per camera.

    Args:
        path, keys, image_size: as for `Hdf5Frames`.
        origins: one dataset per camera of the JPEGs that the frames were decoded from; empty where not kept.
    """

    def __init__(
        self, path: Path, keys: tuple[str, ...], image_size: tuple[int, int], origins: tuple[str, ...] = ()
    ) -> None:
        super().__init__(path, keys, image_size)
        self.origins = origins

    def jpegs(self, step: int) -> tuple[bytes, ...] | None:
        """The JPEGs that were kept, if the frames still are what they decode to."""
        if not self.origins:
            return None
        kept = tuple(_jpeg(row) for row in self._rows(step, self.origins))
        decoded = np.empty((*self.image_size, 3), np.uint8)
        for jpeg, row in zip(kept, self._rows(step, self.keys), strict=True):
            try:
                decode_jpeg(jpeg, decoded)
            except ValueError:
                return None
            if not np.array_equal(decoded, row):
                return None
        return kept

    def read(self, step: int, out: np.ndarray) -> None:
        for row, picture in zip(self._rows(step, self.keys), out, strict=True):
            picture[:] = row


def hdf5_frames(file: h5py.File, keys: Sequence[str], frames: int, origins: Sequence[str] = ()) -> FrameSource:
    """The source of some cameras of an HDF5 file, each checked and each JPEGs or plain pictures.

    Args:
        file: open file.
        keys: one dataset per camera.
        frames: how many pictures each has to have.
        origins: for plain pictures, the datasets of the JPEGs they were decoded from.

    Raises:
        DataError: another number or type of pictures, one that is no JPEG, pictures of different or absurd sizes, or
            plain pictures that were declared and never stored.
    """
    path = Path(file.filename)
    encoded = [_is_encoded(find_dataset(file, key)) for key in keys]
    sizes = [(_check_jpegs if one else _check_raw)(file, key, frames) for one, key in zip(encoded, keys, strict=True)]
    for key in origins:
        _check_jpegs(file, key, frames)

    def source(first: int, last: int) -> FrameSource:
        if encoded[first]:
            return JpegFrames(path, tuple(keys[first:last]), sizes[first])
        return RawFrames(path, tuple(keys[first:last]), sizes[first], tuple(origins[first:last]))

    if len(set(zip(encoded, sizes, strict=True))) == 1:
        return source(0, len(keys))
    return SeveralSources([source(view, view + 1) for view in range(len(keys))])


def colour_cameras(file: h5py.File, keys: Mapping[str, str]) -> tuple[tuple[str, ...], dict[str, str]]:
    """Which cameras have colour pictures, and what the others have instead, such as depth.

    Args:
        file: open file.
        keys: the dataset of each camera.
    """
    colour, others = [], {}
    for camera, key in keys.items():
        found = file.get(key) if has_key(file, key) else None
        if not isinstance(found, h5py.Dataset):
            others[camera] = "no pictures"
        elif _is_encoded(found) or _is_plain(found):
            colour.append(camera)
        else:
            others[camera] = f"{found.dtype} {found.shape}"
    return tuple(colour), others


def _is_encoded(found: h5py.Dataset) -> bool:
    """Whether a dataset holds one encoded picture a row: bytes, or rows of bytes of one or of any length."""
    rows = len(found.shape or ())
    if rows == 1:
        return found.dtype.kind == "S" or h5py.check_vlen_dtype(found.dtype) == np.uint8
    return rows == 2 and found.dtype == np.uint8


def _is_plain(found: h5py.Dataset) -> bool:
    return found.dtype == np.uint8 and len(found.shape or ()) == 4 and found.shape[3] == 3


def _jpeg(row: Any) -> bytes:
    """The bytes of one picture, without the zeros that fill its row up: a JPEG ends in FFD9."""
    return bytes(row).rstrip(b"\0")


def _check_jpegs(file: h5py.File, key: str, frames: int) -> tuple[int, int]:
    """The (height, width) that the frames of a camera have, each checked by its header and end marker."""
    found, where = find_dataset(file, key), f"{file.filename}:{key}"
    if not _is_encoded(found):
        raise DataError(where, "encoded colour pictures", f"{found.shape} {found.dtype}", CHOOSE)
    if found.shape[0] != frames:
        raise DataError(where, f"{frames} pictures, one per row of joints", found.shape, FIX)
    sizes: list[tuple[int, int]] = []
    for step, row in enumerate(_rows_of(found)):
        try:
            sizes.append(jpeg_size(_jpeg(row)))
        except ValueError as error:
            raise DataError(f"{where}[{step}]", "a JPEG", str(error), FIX) from error
        if sizes[step] != sizes[0]:
            raise DataError(f"{where}[{step}]", f"a picture of {sizes[0]}", sizes[step], FIX)
    if max(sizes[0]) > MAX_PIXELS:
        raise DataError(where, f"pictures of at most {MAX_PIXELS} pixels a side", sizes[0], FIX)
    return sizes[0]


def _rows_of(found: h5py.Dataset) -> Iterator[Any]:
    """The rows of a dataset, read some at a time: one by one is slow, and what a file declares is never allocated."""
    size = int(np.prod(found.shape[1:], dtype=np.int64)) * found.dtype.itemsize
    rows = min(MAX_ROWS, max(1, MAX_ROW_BYTES // max(size, 1)))
    for first in range(0, len(found), rows):
        yield from found[first : first + rows]


def _check_raw(file: h5py.File, key: str, frames: int) -> tuple[int, int]:
    """The (height, width) of frames that are plain numbers, checked without reading them."""
    found, where = find_dataset(file, key), f"{file.filename}:{key}"
    shape = tuple(found.shape or ())
    if not _is_plain(found):
        raise DataError(where, "colour pictures, (T, H, W, 3) uint8", f"{shape} {found.dtype}", CHOOSE)
    if shape[0] != frames or min(shape) < 1:
        raise DataError(where, f"{frames} pictures, one per row of joints", shape, FIX)
    if max(shape[1:3]) > MAX_PIXELS or int(np.prod(shape[1:])) > MAX_ROW_BYTES:
        raise DataError(where, f"pictures of at most {MAX_ROW_BYTES} bytes", shape[1:], FIX)
    if found.id.get_create_plist().get_nfilters() == 0 and found.id.get_storage_size() < int(np.prod(shape)):
        got = f"{found.id.get_storage_size()} bytes of {int(np.prod(shape))}"
        raise DataError(where, "pictures that are stored completely", got, FIX)
    return shape[1], shape[2]
