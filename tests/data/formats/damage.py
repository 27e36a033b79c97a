"""Makes bad files of good ones: what can happen to any HDF5 file, to some of its keys, and to any file at all."""

import io
import pickle

import h5py
import numpy as np
from PIL import Image

TEXT = h5py.string_dtype("utf-8")


class Evil:
    """A pickle that creates the file `was_run` in the working folder when somebody opens it."""

    def __reduce__(self):
        return (open, ("was_run", "w"))


CODE = pickle.dumps(Evil())


def replace(key, *arguments, **options):
    """Another dataset in the place of one."""

    def damage(file):
        del file[key]
        file.create_dataset(key, *arguments, **options)

    return damage


def poke(key, where, value):
    """Other values in some places."""
    return lambda file: file[key].__setitem__(where, value)


def link(key, target):
    """A link in the place of a key."""

    def damage(file):
        del file[key]
        file[key] = target

    return damage


def change(key, function, **options):
    """What a function makes of the values, or refuses to by returning None."""

    def damage(file):
        values = function(file[key][()])
        del file[key]
        file.create_dataset(key, data=values, **options)

    return damage


def declare(key, shape, **options):
    """A size that is only said; nothing is stored."""

    def damage(file):
        dtype = file[key].dtype
        del file[key]
        file.create_dataset(key, shape, dtype, **options)

    return damage


def virtual(key):
    """Data that are in another file."""

    def damage(file):
        shape, dtype = file[key].shape, file[key].dtype
        del file[key]
        layout = h5py.VirtualLayout(shape, dtype)
        layout[:] = h5py.VirtualSource("elsewhere.hdf5", "x", shape)
        file.create_virtual_dataset(key, layout)

    return damage


def external(key, path):
    """Data that are in any other file of the machine."""

    def damage(file):
        shape, dtype = file[key].shape, file[key].dtype
        del file[key]
        file.create_dataset(key, shape, dtype, external=[(path, 0, h5py.h5f.UNLIMITED)])

    return damage


def group_instead(key):
    """A group in the place of data."""

    def damage(file):
        del file[key]
        file.create_group(key)

    return damage


def renamed(key):
    """The same under another name."""
    return lambda file: file.move(key, key + "_x")


def _filled(rows, width, value):
    def make(values):
        found = np.array(values, np.float64)
        found[rows, width] = value
        return found

    return make


def numbers(key):
    """What can happen to a matrix of numbers that a reader needs: by name, a function of the open file."""
    other = {
        "missing": lambda file: file.pop(key),
        "renamed": renamed(key),
        "a group": group_instead(key),
        "NaN": change(key, _filled(0, 0, np.nan)),
        "NaN at the end": change(key, _filled(-1, -1, np.nan)),
        "infinity": change(key, _filled(-1, 0, -np.inf)),
        "beyond float32": change(key, _filled(0, -1, 1e300)),
        "integers": change(key, lambda values: values.astype(np.int64)),
        "complex": change(key, lambda values: values.astype(np.complex64)),
        "booleans": change(key, lambda values: values > 0),
        "texts": change(key, lambda values: values.astype("S8")),
        "texts of variable width": change(key, lambda values: values.astype(str).astype(object), dtype=TEXT),
        "pickles": change(key, lambda values: np.full(values.shape, CODE)),
        "opaque pickles": change(key, lambda values: np.full(values.shape, np.void(CODE))),
        "records": change(key, lambda values: np.zeros(values.shape, [("a", "f4"), ("b", "i2")])),
        "lists": change(key, lambda values: _ragged(len(values)), dtype=h5py.vlen_dtype(np.float32)),
        "references": change(key, lambda values: np.full(values.shape, None, object), dtype=h5py.ref_dtype),
        "flat": change(key, lambda values: values.reshape(-1)),
        "one axis more": change(key, lambda values: values[..., None]),
        "no rows": change(key, lambda values: values[:0]),
        "a row less": change(key, lambda values: values[:-1]),
        "a row more": change(key, lambda values: np.concatenate([values, values[-1:]])),
        "a scalar": change(key, lambda values: values.flat[0]),
        "without content": replace(key, data=h5py.Empty("f4")),
        "absurdly long": declare(key, (10**12, 14), chunks=(1, 14)),
        "absurdly wide": declare(key, (5, 10**12), chunks=(1, 1000)),
        "long and never stored": declare(key, (90_000, 200_000)),
        "absurd chunks": declare(key, (5, 14), chunks=(10**7, 14), maxshape=(None, 14)),
    }
    return other | elsewhere(key)


def links(key):
    """Links in the place of anything."""
    return {
        "a soft link": link(key, h5py.SoftLink("/")),
        "a soft link to itself": link(key, h5py.SoftLink("/" + key)),
        "a dangling link": link(key, h5py.SoftLink("/nowhere")),
        "an external link": link(key, h5py.ExternalLink("/etc/passwd", "x")),
    }


def elsewhere(key):
    """Data that are not in the file."""
    return links(key) | {
        "external storage": external(key, "/dev/zero"),
        "external storage in a text": external(key, "/etc/passwd"),
        "virtual": virtual(key),
    }


def _ragged(rows):
    found = np.empty(rows, object)
    found[:] = [np.zeros(3, np.float32)] * rows
    return found


def jpeg(size=(24, 32), mode="RGB", **options):
    """A grey picture, compressed."""
    out = io.BytesIO()
    Image.new(mode, size[::-1]).save(out, "JPEG", **options)
    return out.getvalue()


def claims(height, width):
    """A JPEG of 24x32 whose header says another size."""
    data = jpeg()
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + height.to_bytes(2, "big") + width.to_bytes(2, "big") + data[at + 4 :]


PICTURES = {
    "no picture": b"GIF89a",
    "nothing": b"",
    "a PNG": b"\x89PNG\r\n\x1a\n" + bytes(100),
    "a pickle": CODE,
    "only marks": b"\xff\xd8junk\xff\xd9",
    "a JPEG cut off": jpeg()[:300],
    "a JPEG of another size": jpeg((16, 16)),
    "a JPEG of 65500 pixels": claims(65500, 65500),
    "a JPEG of no height": claims(0, 32),
    "a JPEG taller than it is": claims(48, 32),
}
ODD_PICTURES = {  # which may be read or refused
    "a grey JPEG": jpeg(mode="L"),
    "a JPEG for printers": jpeg(mode="CMYK"),
    "a progressive JPEG": jpeg(progressive=True),
    "a JPEG without its middle": jpeg()[:-60] + b"\xff\xd9",
    "a JPEG with a long comment": jpeg()[:2] + b"\xff\xfe\xff\xff" + bytes(0xFFFD) + jpeg()[2:],
    "a JPEG with segments of no length": jpeg()[:2] + b"\xff\xfe\x00\x00" * 50 + jpeg()[2:],
}


def pictures(key, which=tuple(PICTURES)):
    """What can happen to the JPEGs of a camera."""
    every = PICTURES | ODD_PICTURES
    found = {name: change(key, lambda values, name=name: _with(values, 2, every[name])) for name in which}
    return found


def _with(values, at, data):
    rows = [bytes(value) for value in values]
    rows[at] = data
    return np.array(rows, dtype=f"S{max(1, *map(len, rows))}")


def stream(key):
    """What can happen to a camera of JPEGs as a whole."""
    other = {
        "missing": lambda file: file.pop(key),
        "renamed": renamed(key),
        "a group": group_instead(key),
        "numbers": change(key, lambda values: np.zeros(len(values))),
        "of variable width": replace(key, data=["text"] * 13, dtype=TEXT),
        "a row less": change(key, lambda values: values[:-1]),
        "no rows": change(key, lambda values: values[:0]),
        "absurdly long": declare(key, (10**12,), chunks=(100,)),
        "absurd pictures": replace(key, (7,), "S300000000", chunks=(1,)),
    }
    return other | pictures(key) | elsewhere(key)


def raw(key):
    """What can happen to a camera of plain pictures."""
    rows = {"compression": "gzip"}
    other = {
        "missing": lambda file: file.pop(key),
        "renamed": renamed(key),
        "a group": group_instead(key),
        "floats": change(key, lambda values: values.astype(np.float32)),
        "pickles": change(key, lambda values: np.full(values.shape[:1], CODE)),
        "grey": change(key, lambda values: values[..., 0]),
        "four colours": change(key, lambda values: np.concatenate([values, values[..., :1]], -1)),
        "a row less": change(key, lambda values: values[:-1]),
        "no rows": change(key, lambda values: values[:0]),
        "no height": change(key, lambda values: values[:, :0]),
        "never stored": declare(key, (8, 24, 32, 3), chunks=(1, 24, 32, 3)),
        "absurdly large": declare(key, (8, 10**6, 10**6, 3), chunks=(1, 100, 100, 3)),
        "absurdly large and compressed": declare(key, (8, 60_000, 60_000, 3), chunks=(1, 100, 100, 3), **rows),
    }
    return other | elsewhere(key)


def harmless(key):
    """What a reader of a matrix of numbers has to put up with."""
    return {
        "keys of others": lambda file: file.create_dataset("notes/more", data=np.full(3, CODE)),
        "a loop of groups": lambda file: file.__setitem__("round", file["/"]),
        "a pickle as attribute": lambda file: file.attrs.__setitem__("task", np.void(CODE)),
        "attributes of variable width": lambda file: file.attrs.__setitem__("task", "text"),
        "big-endian": change(key, lambda values: values.astype(">f8")),
        "half precision": change(key, lambda values: values.astype(np.float16)),
        "compressed": change(key, lambda values: values, compression="gzip"),
    }


def contents(good, count, rng, start=0):
    """Other bytes than those of a good file: by name, the content of a file."""
    found = {f"cut at {share:.0%}": good[: int(len(good) * share)] for share in (0.0, 0.01, 0.1, 0.3, 0.6, 0.9, 0.99)}
    found |= {"one byte less": good[:-1], "foreign": b"no such file " * 50, "bytes behind": good + rng.bytes(500)}
    for number in range(count):
        damaged = bytearray(good)
        if number % 2:
            at = int(rng.integers(start, len(good)))
            damaged[at] ^= 1 << int(rng.integers(8))
        else:
            at = int(rng.integers(start, len(good) - 16))
            damaged[at : at + 16] = rng.bytes(16)
        found[f"flipped {number} at {at}"] = bytes(damaged)
    for number in range(count // 2):  # where the structure of the file is described
        damaged = bytearray(good)
        at = int(rng.integers(0, min(3000, len(good))))
        damaged[at] ^= int(rng.integers(1, 256))
        found[f"changed {number} at {at}"] = bytes(damaged)
    return found


DOCUMENTS = {
    "empty": b"",
    "cut off": b'{"episodes": [',
    "a list": b"[1, 2]",
    "a number": b"1e999",
    "deep": b"[" * 200_000,
    "deep objects": b'{"a":' * 200_000,
    "an endless number": b"9" * 10_000,
    "not UTF-8": b"\xff\xfe{\x00}\x00",
    "binary": bytes(range(256)) * 20,
    "a pickle": CODE,
    "an object without anything": b"{}",
}
VALUES = (None, -1, 1e999, 10**30, "text", "{0.__class__}", [[]], {"a": {"b": []}})
