"""Video files as a source of pictures: the frame of an exact time, and writing one file per camera."""

import os
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ugr_lightning.data.storage.frames import MAX_PIXELS, FrameSource
from ugr_lightning.errors import DataError, require_extra

FIX = "Copy the dataset again, or leave this episode out."
ENCODING = {"preset": "veryfast", "crf": "18", "g": "2", "bf": "0", "mbtree": "0", "rc-lookahead": "0"}
"""H.264 that shows no loss to the eye; every second frame can be jumped to, so that looking ahead would gain nothing.

It would cost sameness: x264 165 with AVX-512 then encodes the same pictures otherwise once in a while.
"""
AHEAD = 8  # frames that are decoded rather than jumped over


def import_av() -> Any:
    """PyAV, which reads and writes video.

    Raises:
        ConfigError: it is not installed.
    """
    require_extra("video files", "lerobot", "av")
    import av

    return av


class View(NamedTuple):
    """Where one camera's pictures of an episode are.

    Args:
        path: video file, which may hold other episodes, too.
        key: the camera, in words of the format.
        start: time in the file at which the episode begins, s.
    """

    path: Path
    key: str
    start: float


class VideoFrames(FrameSource):
    """Frames in video files, one file per camera.

    Frames in order are decoded one after the other; any other is found from the nearest key frame before it. What is
    delivered is always the frame of the wanted time, within a quarter of a frame. Videos are opened at the first read
    in each process.

    Args:
        views: one per camera.
        times: (T,) time of each step since the start of the episode, s.
        fps: frames per second.
        image_size: (height, width) that every frame has.
    """

    def __init__(self, views: Sequence[View], times: np.ndarray, fps: float, image_size: tuple[int, int]) -> None:
        self.views, self.times, self.fps, self.image_size = tuple(views), times, fps, image_size
        self.keys = tuple(f"{view.key}@{view.start:.6f}" for view in views)
        self._opened: tuple[int, list[_Decoder]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None}

    @property
    def files(self) -> tuple[Path, ...]:
        return tuple(view.path for view in self.views)

    def read(self, step: int, out: np.ndarray) -> None:
        av = import_av()
        for index, (view, picture) in enumerate(zip(self.views, out, strict=True)):
            where = f"{view.path}[{step}]"
            try:
                found = self._decoders()[index].decode(view.start + float(self.times[step]), 0.25 / self.fps)
            except (av.FFmpegError, OSError, ValueError, IndexError, StopIteration) as error:
                self.close()
                raise DataError(where, "the frame of this step", f"none ({error or 'the end'})", FIX) from error
            if found.shape != picture.shape:
                raise DataError(where, f"a picture of {picture.shape[:2]}", found.shape[:2], FIX)
            picture[:] = found

    def close(self) -> None:
        if self._opened is not None and self._opened[0] == os.getpid():
            for decoder in self._opened[1]:
                decoder.container.close()
        self._opened = None

    def _decoders(self) -> "list[_Decoder]":
        if self._opened is None or self._opened[0] != os.getpid():
            self._opened = (os.getpid(), [_Decoder(view.path) for view in self.views])
        return self._opened[1]


class _Decoder:
    """One open video."""

    def __init__(self, path: Path) -> None:
        av = import_av()
        self.container = av.open(str(path))
        self.stream = _first_stream(self.container)
        self.stream.codec_context.thread_count = 1  # episodes are decoded beside each other, see `data.cache`
        self.convert = av.video.reformatter.VideoReformatter()
        self.coming: Iterator[Any] = iter(())
        self.last: Any = None

    def decode(self, time: float, tolerance: float) -> np.ndarray:
        """The frame of a time, (H, W, 3) uint8 RGB.

        Raises:
            ValueError: no frame within `tolerance` seconds of it.
        """
        unit = float(self.stream.time_base)
        wanted, margin = time / unit, tolerance / unit  # in ticks of the stream, as `pts` is
        if self.last is None or not -margin <= wanted - self.last.pts <= 4 * AHEAD * margin:
            self._jump(wanted)
        while self.last.pts < wanted - margin:
            self.last = self._next()
        if self.last.pts > wanted + margin:
            raise ValueError(f"nothing at {time:.4f} s, the next at {self.last.pts * unit:.4f} s")
        return self.convert.reformat(self.last, format="rgb24").to_ndarray()

    def _jump(self, wanted: float) -> None:
        """Go to the last key frame that is shown no later than wanted."""
        self.container.seek(max(0, round(wanted)), stream=self.stream, backward=True)
        self.coming = self.container.decode(self.stream)
        self.last = self._next()

    def _next(self) -> Any:
        return next(frame for frame in self.coming if frame.pts is not None)


def _first_stream(container: Any) -> Any:
    stream = container.streams.video[0]
    if stream.codec_context is None:
        raise ValueError("a codec that PyAV does not know")
    return stream


def check_video(path: Path) -> tuple[tuple[int, int], float]:
    """Open a video and see what it says of itself.

    Returns:
        (height, width), and the time at which it ends, s.

    Raises:
        DataError: missing, no video, or of an absurd size.
        ConfigError: PyAV is not installed.
    """
    if not path.is_file():
        raise DataError(path, "a video file", "no such file", "Download the videos of the dataset, too.")
    stat = path.stat()
    return _checked(path, stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=4096)
def _checked(path: Path, size: int, changed_ns: int) -> tuple[tuple[int, int], float]:
    av = import_av()
    try:
        with av.open(str(path)) as container:
            stream = _first_stream(container)
            shape = (stream.height, stream.width)
            ticks = (stream.start_time or 0) + (stream.duration or 0)
            end = float(ticks * stream.time_base)
    except (av.FFmpegError, OSError, ValueError, IndexError, TypeError) as error:
        raise DataError(path, "a readable video", f"{error}"[:120] or "none", FIX) from error
    if not 1 <= min(shape) <= max(shape) <= MAX_PIXELS:
        raise DataError(path, f"pictures of 1 to {MAX_PIXELS} pixels a side", shape, FIX)
    return shape, end


def write_videos(paths: Sequence[Path], frames: Iterator[Sequence[np.ndarray]], fps: int) -> None:
    """Write one H.264 file per camera.

    Args:
        paths: the files, whatever their names end with.
        frames: per step V pictures (H, W, 3) uint8 RGB.
        fps: frames per second.

    Raises:
        ConfigError: PyAV is not installed.
    """
    av = import_av()
    outputs: list[tuple[Any, Any]] = []
    try:
        for pictures in frames:
            if not outputs:
                outputs = [
                    _open_output(av, path, one.shape[:2], fps) for path, one in zip(paths, pictures, strict=True)
                ]
            for (container, stream), picture in zip(outputs, pictures, strict=True):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")))
        for container, stream in outputs:
            container.mux(stream.encode())
    finally:
        for container, _ in outputs:
            container.close()


def _open_output(av: Any, path: Path, size: Sequence[int], fps: int) -> tuple[Any, Any]:
    container = av.open(str(path), "w", format="mp4", options={"movflags": "faststart"})
    stream = container.add_stream("libx264", fps, options=ENCODING)
    stream.height, stream.width = size
    stream.pix_fmt = "yuv420p" if size[0] % 2 == size[1] % 2 == 0 else "yuv444p"  # 4:2:0 halves both sides
    return container, stream
