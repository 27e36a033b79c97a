"""`ugr doctor`: what of this machine works, and what to do about the rest."""

import importlib
import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from rich.console import Console
from rich.markup import escape

from ugr_lightning.cli.parsing.call import call
from ugr_lightning.errors import simulator_advice
from ugr_lightning.models.precision import bf16_is_fast
from ugr_lightning.sim.render import probe_rendering
from ugr_lightning.system.limits import available_memory, usable_cores

Status = Literal["ok", "warn", "fail"]
COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}
DISK_GIB = 5.0
MEMORY_GIB = 4.0
PICTURE_SECONDS = 120
PICTURE_PROGRAM = """
import sys
import numpy as np
from PIL import Image
from ugr_lightning.sim.sapien_simulator import SapienSimulator
with SapienSimulator("click_alarmclock", image_size=(240, 320)) as simulator:
    Image.fromarray(np.concatenate(simulator.reset(0).images, axis=1)).save(sys.argv[1])
"""


class Finding(NamedTuple):
    """One line of the report.

    Args:
        status: `ok`; `warn`, something is slower or missing; `fail`, a main command cannot work.
        what: what was looked at.
        found: what was there.
        advice: what to do about it; empty when nothing needs doing.
    """

    status: Status
    what: str
    found: str
    advice: str = ""


def _doctor() -> int:
    """Check this machine and say what to do."""
    console = Console(highlight=False, emoji=False, soft_wrap=True)
    with console.status("looking at this machine"):  # draws nothing where there is no terminal
        findings = [finding for check in CHECKS for finding in check()]
    width = max(len(finding.what) for finding in findings)
    for status, what, found, advice in findings:
        words = escape(f"{found}  -> {advice}" if advice else found)
        console.print(f"[{COLOURS[status]}]{status:<4}[/]  {what:<{width}}  {words}")
    failed, warned = (sum(finding.status == status for finding in findings) for status in ("fail", "warn"))
    console.print(f"{len(findings)} checks: {failed} failed, {warned} with a warning")
    return int(failed > 0)


run = partial(call, _doctor)


def check_python() -> Iterator[Finding]:
    """The interpreter and the machine it runs on."""
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {usable_cores()} cores"
    if sys.version_info < (3, 13):
        yield Finding("ok", "Python", found)
    else:
        yield Finding("warn", "Python", found, simulator_advice())


def check_torch() -> Iterator[Finding]:
    """PyTorch, its devices, and what `precision: auto` picks on each."""
    yield Finding("ok", "PyTorch", f"{torch.__version__}, {torch.get_num_threads()} threads, {_accelerator()}")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    # the public name for these came later than the pinned version
    units = {"AMX": torch.cpu._is_amx_tile_supported, "AVX512-BF16": torch.cpu._is_avx512_bf16_supported}
    has = [name for name, supported in units.items() if supported()] if device.type == "cpu" else ["CUDA"]
    if bf16_is_fast(device):
        yield Finding("ok", "precision", f"`auto` picks bf16 on {device.type} ({', '.join(has)})")
    else:
        advice = "Nothing to repair: without AMX or AVX512-BF16 (or CUDA) training takes about twice as long."
        yield Finding("warn", "precision", f"`auto` picks fp32 on {device.type}", advice)


def check_packages() -> Iterator[Finding]:
    """The packages that training, logging and simulation stand on."""
    for what, distribution, module in (
        ("Lightning", "lightning", "lightning"),
        ("TensorBoard", "tensorboard", "tensorboard"),
        ("SAPIEN", "sapien", None),  # a bad driver can end the process that imports it; the probe does that
        ("ManiSkill", "mani-skill", None),
    ):
        yield _package(what, distribution, module)


def check_rendering() -> Iterator[Finding]:
    """The Vulkan device, and a picture that SAPIEN really rendered."""
    probe = probe_rendering()
    if not probe.ok:
        yield Finding("fail", "Vulkan device", probe.device or "none that SAPIEN can render with", probe.message)
        yield Finding("fail", "SAPIEN picture", "not tried", "Training works; recording and rollouts need a renderer.")
        return
    yield Finding("ok", "Vulkan device", probe.device)
    yield _picture(Path(tempfile.gettempdir()) / "ugr-doctor.png")


def check_resources() -> Iterator[Finding]:
    """Room on the disk and in memory."""
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    advice = f"The demo wants {DISK_GIB:.0f} GiB for demonstrations, cache and checkpoints: free some."
    short = free < DISK_GIB
    yield Finding("warn" if short else "ok", "disk", f"{free:.1f} GiB free in {Path.cwd()}", advice if short else "")
    memory = available_memory()
    if memory is None:
        return
    available = memory / 2**30
    short = available < MEMORY_GIB
    advice = f"Training and rollouts want {MEMORY_GIB:.0f} GiB: close something, or use `--data.cache memmap`."
    yield Finding("warn" if short else "ok", "memory", f"{available:.1f} GiB available", advice if short else "")


CHECKS: tuple[Callable[[], Iterator[Finding]], ...] = (
    check_python,
    check_torch,
    check_packages,
    check_rendering,
    check_resources,
)


def _accelerator() -> str:
    if not torch.cuda.is_available():
        return "no GPU"
    return ", ".join(torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count()))


def _package(what: str, distribution: str, module: str | None) -> Finding:
    try:
        version = importlib.metadata.version(distribution)
        if module is not None:
            importlib.import_module(module)
    except ImportError as error:  # PackageNotFoundError is one
        simulator = distribution in ("sapien", "mani-skill")
        advice = simulator_advice(error) if simulator else "Install the pinned packages: make setup"
        return Finding("fail", what, f"cannot be used ({error})", advice)
    return Finding("ok", what, version)


def _picture(path: Path) -> Finding:
    """Render the first task's first frame in a process of its own, because a driver may crash instead of raising."""
    command = [sys.executable, "-c", PICTURE_PROGRAM, str(path)]
    try:
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            command, env=environment, timeout=PICTURE_SECONDS, capture_output=True, text=True, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding("fail", "SAPIEN picture", f"nothing after {PICTURE_SECONDS} s", "Try again on an idle machine.")
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        return Finding("fail", "SAPIEN picture", reason, "Run scripts/setup_vulkan.sh; report this line if it stays.")
    return Finding("ok", "SAPIEN picture", f"rendered, look at {path}")
