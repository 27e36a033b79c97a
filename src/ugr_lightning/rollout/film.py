"""Videos of episodes: animated GIF (Pillow) or MP4 (imageio's ffmpeg), pictures side by side, uncertainty below."""

from collections.abc import Sequence
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from PIL import Image, ImageDraw

from ugr_lightning.data.pins import ARM_COLOURS, draw_pins
from ugr_lightning.errors import ConfigError
from ugr_lightning.system.files import publish

STRIP_HEIGHT = 12
GIF_WIDTH = 640
"""Wider films are halved, or made smaller still, as GIF: it hardly compresses."""
SUCCESS_COLOUR, ALARM_COLOUR, TEXT_COLOUR = (40, 170, 70), (220, 40, 40), (255, 255, 255)
CERTAIN = 0.1
"""Probability of a cell of a map from which on it is drawn at full strength."""


def compose_frames(
    images: Sequence[np.ndarray],
    *,
    log_variance: Sequence[np.ndarray | None] | None = None,
    success: Sequence[bool] | None = None,
    alarm: int | None = None,
    every: int = 1,
) -> np.ndarray:
    """Put the cameras of each step side by side and write the step, success, alarm and s_k on them.

    Args:
        images: per step (V, H, W, 3) uint8 RGB.
        log_variance: per step the s_k (K,) of the newest chunk, None where there is none yet; drawn as a strip below
            the pictures, k from left to right, dark certain and bright uncertain over the episode's range.
        success: per step whether the task's condition has been met.
        alarm: step from which on an alarm is raised, or None.
        every: keep every n-th step; the last one always.

    Returns:
        (T, H', W', 3) uint8 RGB, the form that TensorBoard's `add_images` takes with `dataformats="NHWC"`.
    """
    known = [values for values in log_variance or [] if values is not None]
    low, high = (min(map(np.min, known)), max(map(np.max, known))) if known else (0.0, 1.0)
    steps = sorted({*range(0, len(images), every), len(images) - 1})
    frames = []
    for step in steps:
        picture = Image.fromarray(np.concatenate(list(images[step]), axis=1))  # (H, V W, 3)
        drawing = ImageDraw.Draw(picture)
        done = bool(success[step]) if success is not None else False
        alarmed = alarm is not None and step >= alarm
        said = f"{step}{'  alarm' if alarmed else ''}{'  success' if done else ''}"
        scale = -(-picture.width // GIF_WIDTH)
        drawing.text((3, 1), said, TEXT_COLOUR, font_size=10 * scale, stroke_width=scale, stroke_fill=(0, 0, 0))
        if done or alarmed:
            colour = SUCCESS_COLOUR if done else ALARM_COLOUR
            drawing.rectangle((0, 0, picture.width - 1, picture.height - 1), outline=colour, width=2 * scale)
        frame = np.asarray(picture)
        if known and log_variance is not None:
            frame = np.concatenate([frame, _strip(log_variance[step], frame.shape[1], float(low), float(high))])
        frames.append(frame)
    return np.stack(frames)


def draw_keyframes(
    images: Sequence[np.ndarray],
    maps: Sequence[np.ndarray | None],
    points: Sequence[np.ndarray | None],
    projections: Sequence[np.ndarray | None],
) -> Sequence[np.ndarray]:
    """Show where a policy expects each hand to grip next: its maps as a glow, and what all cameras agree on as a pin.

    The pin's head is the tool, its point the tool's foot on the table; it stays in its place while cameras move.

    Args:
        images: per step (V, H, W, 3) uint8 RGB.
        maps: per step (V, 2, 2, h, w), see `Chunk`; None where the policy was not asked. May end early.
        points: per step (2, 2, 3) m, the newest ones; None where there are none. May end early.
        projections: per step (V, 3, 4), see `embodiment.image_projection`; None where nobody knows.

    Returns:
        Pictures as they came in; the same where there is nothing to draw.
    """
    if not any(found is not None for found in points):
        return images
    drawn = []
    for step, views in enumerate(images):
        glow = maps[step] if step < len(maps) else None
        pins = points[step] if step < len(points) else None
        shown = [views[view] if glow is None else _glowing(views[view], glow[view]) for view in range(len(views))]
        projection = projections[step]
        if pins is not None and projection is not None:
            shown = [draw_pins(picture, pins, matrix) for picture, matrix in zip(shown, projection, strict=True)]
        drawn.append(np.stack(shown))
    return drawn


def _glowing(picture: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """A picture (H, W, 3) with the maps (2, 2, h, w) of both arms over it."""
    size = (picture.shape[1], picture.shape[0])
    mixed = picture.astype(np.float32)
    for chance, colour in zip(maps.max(1), ARM_COLOURS, strict=True):
        strength = np.sqrt(np.clip(chance / CERTAIN, 0, 1)).astype(np.float32)  # (h, w)
        part = 0.7 * np.asarray(Image.fromarray(strength).resize(size, Image.Resampling.BILINEAR))[..., None]
        mixed += part * (np.array(colour, np.float32) - mixed)
    return mixed.round().astype(np.uint8)


def _strip(values: np.ndarray | None, width: int, low: float, high: float) -> np.ndarray:
    """(STRIP_HEIGHT, width, 3): one bar per k, dark blue to yellow; grey where nothing has been predicted."""
    if values is None:
        return np.full((STRIP_HEIGHT, width, 3), 60, np.uint8)
    share = np.clip((np.asarray(values, np.float64) - low) / max(high - low, 1e-6), 0, 1)  # (K,)
    colours = np.stack([30 + 225 * share, 30 + 190 * share, 90 - 60 * share], axis=-1)  # (K, 3)
    bars = colours[np.arange(width) * len(share) // width]  # (width, 3)
    return np.broadcast_to(bars, (STRIP_HEIGHT, width, 3)).astype(np.uint8)


def check_film_name(path: Path) -> None:
    """Refuse a name that does not say what kind of video it is.

    Raises:
        ConfigError: it ends neither in .gif nor in .mp4.
    """
    if path.suffix not in (".gif", ".mp4"):
        raise ConfigError(path, "a video ending in .gif or .mp4", path.suffix or "none", "Change the name's ending.")


def write_video(path: str | Path, frames: Sequence[np.ndarray] | np.ndarray, *, fps: float = 25.0) -> None:
    """Write frames as `.gif` or `.mp4`, complete or not at all.

    Args:
        path: the ending decides the format.
        frames: (H, W, 3) uint8 RGB each.
        fps: pictures per second of the recording; played at this speed.

    Raises:
        ConfigError: another ending, or no frames.
    """
    path = Path(path)
    check_film_name(path)
    if not len(frames):
        raise ConfigError(path, "a video with frames", "none", "Film an episode that has begun.")
    write = _write_gif if path.suffix == ".gif" else _write_mp4
    publish(path, lambda partial: write(partial, frames, fps), keep_ending=True)


def _write_gif(path: Path, frames: Sequence[np.ndarray] | np.ndarray, fps: float) -> None:
    """One palette for all frames: Pillow then stores only what changes, a third of the size; wide ones are shrunk."""
    shrink = -(-frames[0].shape[1] // GIF_WIDTH)
    frames = [frame[::shrink, ::shrink] for frame in frames]
    sample = np.concatenate([*frames[:: max(1, len(frames) // 4)], frames[-1]])  # the last has the colour of a success
    palette = Image.fromarray(sample).quantize(128, dither=Image.Dither.NONE)
    pictures = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration = max(20, round(1000 / fps / 10) * 10)  # GIF counts in hundredths of a second
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=duration, loop=0, optimize=False)


def _write_mp4(path: Path, frames: Sequence[np.ndarray] | np.ndarray, fps: float) -> None:
    height, width = frames[0].shape[:2]
    size = (width + width % 2, height + height % 2)  # yuv420p wants even sizes
    writer = imageio_ffmpeg.write_frames(str(path), size, fps=fps, codec="libx264", macro_block_size=1)
    writer.send(None)
    try:
        for frame in frames:
            writer.send(np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge").tobytes())
    finally:
        writer.close()
