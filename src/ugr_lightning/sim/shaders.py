"""The shaders of our cameras: SAPIEN's smallest pack without light from an environment map, which no scene here has.

When a process takes its first picture, SAPIEN integrates a table for such light; without a GPU that takes 7 seconds.
What the table is multiplied with is black, so the pictures are the same bit for bit without it.
"""

import functools
import hashlib
import importlib.util
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from ugr_lightning.system.files import publish_folder

# file -> what is edited, each pattern to be found once, and what takes its place
_EDITS = {
    "gbuffer.frag": (
        (r"layout\(set = \d, binding = \d\) uniform sampler2D samplerBRDFLUT;\n", ""),
        (r"texture\(samplerBRDFLUT, [^;]*\.xy;", "vec2(0);"),
        (r"color \+= diffuseIBL\([^;]*;", ""),
        (r"color \+= specularIBL\([^;]*;", ""),
    ),
    "composite0.frag": ((r"layout\(set = \d, binding = \d\) uniform sampler2D samplerBRDFLUT;\n", ""),),
}
_FORMATS = {"Color": "r8g8b8a8unorm", "ColorRaw": "r8g8b8a8unorm", "PositionSegmentation": "r16g16b16a16sint"}


@functools.cache
def plain_shaders(installed: Path | None = None) -> Path | None:
    """Folder of the pack, derived from the installed SAPIEN's on first use and kept in the user's cache.

    Args:
        installed: SAPIEN's folder of shader packs; None finds it.

    Returns:
        None where SAPIEN's pack is not the one that the edits are for; its own then shows the same, seconds later.
    """
    if installed is None:
        package = importlib.util.find_spec("sapien")
        if package is None or package.origin is None:
            return None
        installed = Path(package.origin).parent / "vulkan_shader"
    edited = {path.name: _edit(path) for path in sorted(installed.glob("minimal/*"))}
    texts = {name: text for name, text in edited.items() if text is not None}
    if not texts.keys() >= _EDITS.keys():
        return None

    def write(folder: Path) -> None:
        shutil.copytree(installed / "common", folder / "common")  # the shaders include ../common/*.glsl
        (folder / "plain").mkdir()
        for name, text in texts.items():
            (folder / "plain" / name).write_text(text, encoding="utf-8")

    digest = hashlib.sha256("".join(texts.values()).encode()).hexdigest()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = cache / "ugr-lightning" / f"shaders-{digest[:16]}"
    try:
        if not folder.is_dir():
            publish_folder(folder, write)
    except OSError:
        if not folder.is_dir():  # otherwise another process was first, with the same content
            raise
    return folder / "plain"


def camera_shader() -> Any:
    """The pack as ManiSkill's `ShaderConfig`; cameras that are built next take their pictures in its formats."""
    import sapien
    from mani_skill.render.shaders import PREBUILT_SHADER_CONFIGS

    minimal, folder = PREBUILT_SHADER_CONFIGS["minimal"], plain_shaders()
    if folder is None:
        return minimal
    for name, form in _FORMATS.items():  # ManiSkill does so only for packs that it knows by name
        sapien.render.set_picture_format(name, form)
    return replace(minimal, shader_pack=str(folder))


def _edit(path: Path) -> str | None:
    """The file's text after the edits, None where one does not apply."""
    text = path.read_text(encoding="utf-8")
    for pattern, replacement in _EDITS.get(path.name, ()):
        text, count = re.subn(pattern, replacement, text)
        if count != 1:
            return None
    return text
