"""Every error a user can meet: where it happened, what was expected, what was found, and what to do about it."""

import importlib
import sys


class UGRError(Exception):
    """A problem that the user can solve; printed as one paragraph, never as a traceback.

    Args:
        where: file, key, setting or component in which the problem was found.
        expected: what should have been there.
        got: what was there.
        fix: what to do, as a sentence; a command where there is one.
    """

    def __init__(self, where: object, expected: object, got: object, fix: str) -> None:
        self.where, self.expected, self.got, self.fix = str(where), str(expected), str(got), fix
        super().__init__(where, expected, got, fix)

    def __str__(self) -> str:
        return f"{self.where}: expected {self.expected}, got {self.got}. {self.fix}"


class ConfigError(UGRError):
    """A configuration value or a command-line argument that cannot work."""


class DataError(UGRError):
    """A demonstration file or folder that is missing, damaged or of another kind."""


class CheckpointError(UGRError):
    """A checkpoint that is missing, damaged, unsafe or made for something else."""


class SimulationError(UGRError):
    """A simulator that cannot start, hangs or has crashed."""


class RenderError(SimulationError):
    """No Vulkan device that SAPIEN can render with."""


class NumericsError(UGRError):
    """A NaN or infinity in a loss, an observation or an action."""


class ProtocolError(UGRError):
    """An observation or a message of another program that does not keep to the agreed form."""


def require_extra(where: object, extra: str, *modules: str) -> None:
    """Make sure that packages are there which only some users need.

    Args:
        where: what needs them.
        extra: the group of pyproject.toml that brings them.
        modules: what is imported.

    Raises:
        ConfigError: one of them is missing.
    """
    try:
        for module in modules:
            importlib.import_module(module)
    except ImportError as error:
        fix = f"Install them with `pip install 'ugr-lightning[{extra}]'`."
        raise ConfigError(where, f"the packages of the extra `{extra}`", f"none ({error})", fix) from error


def simulator_advice(cause: object = "") -> str:
    """What to do where SAPIEN or ManiSkill cannot be imported: the `fix` of an error.

    Args:
        cause: what the import said.
    """
    if "libGL" in str(cause):  # ManiSkill imports OpenCV, whose usual build opens windows
        return "Install it: `apt-get install libgl1`, or `pip install --force-reinstall opencv-python-headless`."
    if sys.version_info >= (3, 13):
        return "Use Python 3.11 or 3.12: ManiSkill's planner has no build for newer ones. Training works here, too."
    return "Install the simulator: `pip install sapien mani-skill`. Training works without it."
