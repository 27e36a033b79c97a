"""Objects that record how they were built: what is recorded, what is refused, what is rebuilt."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from deployed import tiny_act

from ugr_lightning.blueprint import Blueprinted, rebuild
from ugr_lightning.errors import CheckpointError, ConfigError
from ugr_lightning.models.diffusion import DiffusionPolicy


@dataclass(frozen=True)
class Size:
    width: int = 3
    scales: tuple[float, ...] = (0.5, 2.0)


@dataclass
class Vision:
    size: Size = field(default_factory=Size)
    crops: list[Size] | None = None


class Part(Blueprinted):
    def __init__(self, ratio: float = 0.3) -> None:
        self.ratio = ratio


class Halved(Part):
    def __init__(self, ratio: float) -> None:
        super().__init__(ratio / 2)


class Whole(Blueprinted):
    def __init__(self, part: Part | None = None, vision: Vision | None = None, names: Sequence[str] = ("a",)) -> None:
        self.part, self.vision, self.names = part, vision, names


class WithoutInit(Whole):
    """Inherits everything."""


class WithFewer(Whole):
    def __init__(self, ratio: float) -> None:
        super().__init__(Part(ratio))
        self.ratio = ratio


class WithMore(Whole):
    def __init__(self, depth: int = 2, **kwargs: object) -> None:
        super().__init__(**kwargs)  # type: ignore[arg-type]
        self.depth = depth


class Mixin:
    def __init__(self, level: int) -> None:
        super().__init__()
        self.level = level


class Mixed(Mixin, Whole):
    """Its constructor is one that does not record."""


class Anything(Blueprinted):
    def __init__(self, value: object = None, *more: object, path: Path | None = None) -> None:
        self.value, self.more, self.path = value, more, path


class Hidden(Blueprinted):
    not_kept = ("weights",)

    def __init__(self, weights: str | None = None) -> None:
        self.weights = weights


class Retired(Anything):
    retired: ClassVar = {"kind": "mlp"}


class HiddenWithFewer(Hidden):
    def __init__(self, size: int = 1) -> None:
        super().__init__("file")
        self.size = size


def attributes(thing: Blueprinted) -> dict[str, object]:
    return {name: value for name, value in vars(thing).items() if name != "_blueprint"}


@pytest.mark.parametrize(
    "built",
    [WithoutInit(names=["b"]), WithFewer(0.7), Mixed(4), HiddenWithFewer(5)],
    ids=lambda thing: type(thing).__name__,
)
def test_a_subclass_is_rebuilt_as_itself_with_its_own_arguments(built):
    again = rebuild(built.blueprint())
    assert type(again) is type(built)
    assert again.blueprint() == built.blueprint()
    assert {k: v for k, v in attributes(again).items() if k != "part"} == {
        k: v for k, v in attributes(built).items() if k != "part"
    }


def test_arguments_behind_kwargs_are_recorded_by_their_own_names():
    built = WithMore(5, part=Part(0.1), vision=Vision())
    recorded = built.blueprint()["init_args"]
    assert recorded["depth"] == 5
    assert recorded["part"]["init_args"] == {"ratio": 0.1}
    again = rebuild(built.blueprint())
    assert (again.depth, again.part.ratio, again.vision) == (5, 0.1, Vision())


def test_dataclasses_are_plain_in_the_blueprint_and_themselves_afterwards():
    vision = Vision(Size(7, (1.5,)), [Size(), Size(1, ())])
    recorded = Whole(vision=vision).blueprint()
    assert recorded["init_args"]["vision"]["size"] == {"width": 7, "scales": [1.5]}
    assert rebuild(recorded).vision == vision


def test_numbers_of_numpy_become_numbers():
    recorded = Anything({"a": np.float32(0.5), "b": [np.int64(3), np.float64(2)]}).blueprint()["init_args"]["value"]
    assert recorded == {"a": 0.5, "b": [3, 2.0]}
    assert [type(item) for item in (recorded["a"], *recorded["b"])] == [float, int, float]


def test_a_path_is_text_in_the_blueprint_and_a_path_again():
    assert rebuild(Anything(path=Path("x")).blueprint()).path == Path("x")


@pytest.mark.parametrize(
    "value", [object(), {1: "a"}, {"a", "b"}, Size(), Path("x"), len], ids=lambda value: type(value).__name__
)
def test_what_cannot_be_recorded_is_refused_when_the_object_is_built(value):
    with pytest.raises(ConfigError, match=r"Anything\.value"):
        Anything(value)
    with pytest.raises(ConfigError, match=r"Anything\.value"):
        Anything([value])


def test_arguments_without_names_and_classes_inside_functions_are_refused_when_built():
    with pytest.raises(ConfigError, match="by name"):
        Anything(1, 2)

    class Inside(Part):
        pass

    with pytest.raises(ConfigError, match="top level"):
        Inside()


def test_what_the_weights_replace_is_not_kept():
    assert Hidden("file").blueprint()["init_args"] == {"weights": None}
    assert HiddenWithFewer().blueprint()["init_args"] == {"size": 1}


def test_an_argument_that_this_version_does_not_have_is_named():
    blueprint = WithFewer(0.5).blueprint()
    blueprint["init_args"]["new"] = 1
    with pytest.raises(CheckpointError, match="new"):
        rebuild(blueprint)
    blueprint = Whole(vision=Vision()).blueprint()
    blueprint["init_args"]["vision"]["new"] = 1
    with pytest.raises(CheckpointError, match="new"):
        rebuild(blueprint)


def test_an_argument_that_is_gone_is_dropped_where_its_value_is_what_is_done_now():
    blueprint = Retired(1).blueprint()
    blueprint["init_args"]["kind"] = "mlp"
    assert rebuild(blueprint).value == 1
    blueprint["init_args"]["kind"] = "decoder"
    with pytest.raises(CheckpointError, match=r"Retired\.kind: expected mlp, got decoder\. .*no longer in the code"):
        rebuild(blueprint)


def test_memory_that_runs_out_is_not_called_a_damaged_checkpoint(monkeypatch):
    blueprint = Halved(1.0).blueprint()

    def full(self, *given, **named):
        raise MemoryError

    monkeypatch.setattr(Halved, "__init__", full)
    with pytest.raises(MemoryError):
        rebuild(blueprint)


@pytest.mark.parametrize("given", [{"ratio": "wide"}, {"ratio": None}, ["ratio"], None])
def test_arguments_that_a_constructor_cannot_use_are_one_error(given):
    class_path = f"{Halved.__module__}.{Halved.__qualname__}"
    with pytest.raises(CheckpointError, match=rf"init_args: expected arguments that {class_path} can be built with"):
        rebuild({"class_path": class_path, "init_args": given})


@pytest.mark.parametrize("path", ["os.system", "no.such.Class", "Nothing", "__main__.Gone"])
def test_only_classes_that_record_themselves_are_built(path):
    with pytest.raises(CheckpointError, match="class_path"):
        rebuild({"class_path": path, "init_args": {}})


@pytest.mark.parametrize(
    ("policy", "given"),
    [
        (tiny_act(), {"refine_branch": "mlp", "backbone_stride": 32, "state_noise": 0.0}),
        (
            DiffusionPolicy(unet_widths=(16, 32), backbone_width=8),
            {"unet_kernel": 5, "unet_groups": 8, "step_dim": 128, "backbone_stride": 32},
        ),
    ],
    ids=["ACT", "DiffusionPolicy"],
)
def test_blueprints_of_before_hold_arguments_that_are_gone(policy, given):
    blueprint = policy.blueprint()
    assert not given.keys() & blueprint["init_args"].keys()
    blueprint["init_args"] |= given
    assert rebuild(blueprint).state_dict().keys() == policy.state_dict().keys()
