"""Parquet tables that nobody vouches for: columns and rows are checked before they are loaded."""

import io
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ugr_lightning.data.storage.frames import MAX_PIXELS, FrameSource
from ugr_lightning.data.storage.hdf5 import MAX_COLUMNS
from ugr_lightning.errors import DataError, require_extra

MAX_BYTES = 2**27  # of numbers that are loaded at a time
MANY = 2**16  # rows of numbers that are decoded at a time
MAX_PICTURE_BYTES = 2**29  # of an episode's encoded pictures
ONE_SIZE = f"pictures of one size, at most {MAX_PIXELS} pixels a side"
FIX = "Copy the dataset again, or leave this episode out."


def import_pyarrow() -> Any:
    """The package pyarrow with its Parquet part.

    Raises:
        ConfigError: it is not installed.
    """
    require_extra("Parquet files", "lerobot", "pyarrow", "pyarrow.parquet")
    import pyarrow

    return pyarrow


def read_table(path: Path, columns: Sequence[str] | Callable[[str], bool], rows: tuple[int, int] | None = None) -> Any:
    """Read some columns and rows of a file.

    Args:
        path: the file.
        columns: their names, or whether a name is wanted.
        rows: first and past-the-last row; None for all.

    Returns:
        `pyarrow.Table` with these columns in this order.

    Raises:
        DataError: missing, damaged, without one of the columns or rows, or absurdly large.
        ConfigError: pyarrow is not installed.
    """
    return import_pyarrow().concat_tables(list(read_pieces(path, columns, rows)))


def read_pieces(
    path: Path, columns: Sequence[str] | Callable[[str], bool], rows: tuple[int, int] | None = None
) -> Iterator[Any]:
    """The tables that `read_table` puts together, decoded one after another; the first may be empty.

    What is absurdly large is noticed early. What the file says of the size of its columns would not do: equal rows
    are stored once. Nor may it be looked at: pyarrow ends the process where that part of a file is damaged.
    """
    pyarrow = import_pyarrow()
    if not path.is_file():
        raise DataError(path, "a Parquet file", "no such file", "Download all files of the dataset.")
    try:
        with pyarrow.parquet.ParquetFile(path) as file:
            if callable(columns):
                columns = list(filter(columns, file.schema_arrow.names))
            missing = [column for column in columns if column not in file.schema_arrow.names]
            if missing:
                got = f"no {', '.join(missing)} among {', '.join(file.schema_arrow.names[:12])}"
                raise DataError(path, "the columns of its kind", got, FIX)
            starts = np.cumsum([0] + [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)])
            first, last = rows or (0, int(starts[-1]))
            if not 0 <= first <= last <= starts[-1]:
                raise DataError(path, f"rows {first} to {last}", f"{starts[-1]} rows", FIX)
            groups = [i for i in range(file.num_row_groups) if starts[i] < last and starts[i + 1] > first]
            skipped = int(starts[groups[0]]) if groups else 0
            yield from _decode(file, path, groups, columns, first - skipped, last - first)
    except (pyarrow.ArrowException, OSError, ValueError, KeyError, TypeError, MemoryError) as error:
        got = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        raise DataError(path, "a readable Parquet file", got, FIX) from error


def _decode(
    file: Any, path: Path, groups: Sequence[int], columns: Sequence[str], first: int, count: int
) -> Iterator[Any]:
    """Some rows of some row groups, a few at a time; at first none, which has the columns' types."""
    pyarrow = import_pyarrow()
    schema = pyarrow.schema([file.schema_arrow.field(column) for column in columns])
    yield schema.empty_table()
    rows = min(_rows_at_once(field.type) for field in schema)
    most, found, size, at = MAX_PICTURE_BYTES if rows < MANY else MAX_BYTES, 0, 0, 0
    options = {"batch_size": rows, "columns": list(columns), "use_threads": False}
    for batch in file.iter_batches(row_groups=list(groups), **options) if count else ():
        start, end = max(0, first - at), min(len(batch), first + count - at)
        at += len(batch)
        if end <= start:
            continue
        piece = batch.select(list(columns)).slice(start, end - start)
        found, size = found + len(piece), size + piece.nbytes
        if size > most:
            raise DataError(path, f"at most {most} bytes of {', '.join(columns)}"[:200], f"{size} and more", FIX)
        yield pyarrow.Table.from_batches([piece])
        if at >= first + count:
            break
    if found != count:
        raise DataError(path, f"{count} rows from {first} on", found, FIX)


def _rows_at_once(kind: Any) -> int:
    """How many rows of a column may be decoded together: numbers and lists of them, texts, or pictures."""
    kinds = import_pyarrow().types
    if kinds.is_struct(kind) or kinds.is_binary(kind) or kinds.is_large_binary(kind):
        return 1
    if kinds.is_list(kind) or kinds.is_large_list(kind) or kinds.is_fixed_size_list(kind):
        kind = kind.value_type
    return MANY if kinds.is_primitive(kind) else 64


def column_values(table: Any, column: str, path: Path) -> np.ndarray:
    """A column of numbers, or of lists of numbers of one length.

    Returns:
        (N,) or (N, D), of the type it is stored in.

    Raises:
        DataError: something else, or something missing in between.
    """
    pyarrow, where = import_pyarrow(), f"{path}:{column}"
    found, kinds = table.column(column).combine_chunks(), pyarrow.types
    if isinstance(found, pyarrow.ChunkedArray):
        found = pyarrow.concat_arrays(found.chunks) if found.num_chunks else pyarrow.array([], found.type)
    if found.null_count:
        raise DataError(where, "a value in every row", f"{found.null_count} rows without", FIX)
    lists = kinds.is_list(found.type) or kinds.is_large_list(found.type) or kinds.is_fixed_size_list(found.type)
    values = found.flatten() if lists else found
    number = kinds.is_integer(values.type) or kinds.is_floating(values.type)
    if not number or values.null_count:
        raise DataError(where, "numbers", f"{found.type}, {values.null_count} of them missing", FIX)
    flat = values.to_numpy(zero_copy_only=False)
    if not lists:
        return flat
    width = len(flat) // max(1, len(found))
    lengths = {width} if kinds.is_fixed_size_list(found.type) else set(np.diff(found.offsets.to_numpy()).tolist())
    if len(lengths) > 1 or not 1 <= width <= MAX_COLUMNS:
        raise DataError(where, f"lists of one length, 1 to {MAX_COLUMNS}", sorted(lengths)[:5], FIX)
    return flat.reshape(len(found), width)


def finite_rows(values: np.ndarray, where: str, first: int = 0) -> np.ndarray:
    """Some rows of a column of vectors as (N, D) float32, a copy; single numbers are vectors of one.

    Args:
        values: (N,) or (N, D), from `column_values`.
        where: file and column, for the error.
        first: number of the first row in the file, for the error.

    Raises:
        DataError: NaN or infinity among them.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        rows = np.array(values.reshape(len(values), -1), dtype=np.float32, order="C")  # (N, D)
    if not np.isfinite(rows).all():
        at = np.argwhere(~np.isfinite(rows))[0].tolist()
        raise DataError(where, "finite numbers", f"{rows[tuple(at)]} at {[at[0] + first, at[1]]}", FIX)
    return rows


class TablePictures(FrameSource):
    """PNG or JPEG pictures in a table, one column of `{bytes, path}` per camera.

    The encoded pictures of an episode are held in memory between the first read and `close`.

    Args:
        path: the file.
        columns: one per camera.
        rows: first and past-the-last row of the episode.

    Raises:
        DataError: pictures that are missing, of another kind, or of different sizes.
    """

    def __init__(self, path: Path, columns: Sequence[str], rows: tuple[int, int]) -> None:
        self.path, self.columns, self.rows = path, tuple(columns), rows
        self.keys = tuple(f"{column}[{rows[0]}:{rows[1]}]" for column in columns)
        self._encoded: list[list[bytes]] | None = None
        self.image_size = self._check()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_encoded": None}

    @property
    def files(self) -> tuple[Path, ...]:
        return (self.path,)

    def read(self, step: int, out: np.ndarray) -> None:
        for column, pictures, picture in zip(self.columns, self._load(), out, strict=True):
            where = f"{self.path}:{column}[{step}]"
            try:
                with Image.open(io.BytesIO(pictures[step]), formats=("PNG", "JPEG")) as image:
                    if image.size != (picture.shape[1], picture.shape[0]):
                        raise DataError(where, f"a picture of {picture.shape[:2]}", image.size[::-1], FIX)
                    picture[:] = np.asarray(image.convert("RGB"))
            except (OSError, ValueError, SyntaxError, IndexError) as error:
                raise DataError(where, "a picture", str(error)[:120], FIX) from error

    def close(self) -> None:
        self._encoded = None

    def _load(self) -> list[list[bytes]]:
        if self._encoded is None:
            table = read_table(self.path, self.columns, self.rows)
            self._encoded = [_pictures(table, column, self.path) for column in self.columns]
        return self._encoded

    def _check(self) -> tuple[int, int]:
        """The common size of all pictures, by their headers."""
        sizes, first = set(), 0
        for piece in read_pieces(self.path, self.columns, self.rows):
            for column in self.columns:
                for step, data in enumerate(_pictures(piece, column, self.path), start=first):
                    sizes.add(_size(data, f"{self.path}:{column}[{step}]"))
            first += len(piece)
        if len(sizes) != 1:
            raise DataError(f"{self.path}:{self.columns}", ONE_SIZE, sorted(sizes), "Choose cameras of one size.")
        return sizes.pop()


def _size(data: bytes, where: str) -> tuple[int, int]:
    """The (height, width) of an encoded picture, by its header."""
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            width, height = image.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DataError(where, "a PNG or JPEG", str(error)[:120], FIX) from error
    if max(height, width) > MAX_PIXELS:
        raise DataError(where, ONE_SIZE, (height, width), "Choose cameras of one size.")
    most = 8 * height * width + 2**20  # without compression at 16 bits a channel, and whatever else a header holds
    if len(data) > most:
        raise DataError(where, f"at most {most} bytes for a picture of {(height, width)}", len(data), FIX)
    return height, width


def _pictures(table: Any, column: str, path: Path) -> list[bytes]:
    return [_picture(item, path, column) for item in table.column(column).to_pylist()]


def _picture(item: Any, path: Path, column: str) -> bytes:
    data = item.get("bytes") if isinstance(item, dict) else None
    if not isinstance(data, bytes):
        raise DataError(f"{path}:{column}", "pictures in the file itself", "none, or only their paths", FIX)
    return data
