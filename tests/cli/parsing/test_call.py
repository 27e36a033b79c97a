from typing import Literal

import pytest

from ugr_lightning.cli.main import main
from ugr_lightning.cli.parsing.call import Count, CountOrZero, call, call_one_of
from ugr_lightning.errors import ConfigError


def test_a_yes_or_no_option_works_as_a_plain_flag(capsys):
    def act(quick: bool = False, count: int = 1) -> int:
        """Act."""
        print(quick, count)
        return 0

    for argv in (["--quick", "--count", "3"], ["--quick"], ["--quick", "false"], []):
        call(act, "act", argv)
    assert capsys.readouterr().out.splitlines() == ["True 3", "True 1", "False 1", "False 1"]


@pytest.mark.parametrize(
    "words",
    [["--where=~/x", "--places=[~/x,y]"], ["--where", "~/x", "--places", "~/x", "y"], ["--config", "given.yaml"]],
)
def test_the_home_folder_is_understood_however_a_path_is_given_also_in_a_list(words, monkeypatch, tmp_path, capsys):
    def act(where: str = "", places: list[str] = []) -> int:  # noqa: B006
        """Act."""
        print(where, places)
        return 0

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/me")
    (tmp_path / "given.yaml").write_text("{where: ~/x, places: [~/x, y]}")
    call(act, "act", words)
    assert capsys.readouterr().out == "/home/me/x ['/home/me/x', 'y']\n"


def test_leading_words_get_the_names_of_options_and_a_list_takes_several_words(capsys):
    def act(first: str, rest: list[str] = [], rates: list[float] | None = None, which: int | list[int] = 0) -> int:  # noqa: B006
        """Act."""
        print(first, rest, rates, which)
        return 0

    for line in (
        "a",
        "--first a --rest b c",
        "a b c --rates 0.5 1 --which 3",
        "a 1 --which 3 4",
        "a [b,c] --rates [1]",
    ):
        call(act, "act", line.split(), ["first", "rest"])
    call(act, "act", ["a", "--rates", "null"], ["first"])
    assert capsys.readouterr().out.splitlines() == [
        "a [] None 0",
        "a ['b', 'c'] None 0",
        "a ['b', 'c'] [0.5, 1.0] 3",
        "a ['1'] None [3, 4]",
        "a ['b', 'c'] [1.0] 0",
        "a [] None 0",
    ]
    with pytest.raises(ConfigError, match="stray"):
        call(act, "act", ["a", "stray"], ["first"])
    with pytest.raises(ConfigError, match="rates"):
        call(act, "act", ["a", "--rates", "0.9", "high"], ["first"])


def test_lightnings_word_for_a_checkpoint_is_understood(capsys):
    def act(checkpoint: str = "best") -> int:
        """Act."""
        print(checkpoint)
        return 0

    for argv in (["last"], ["--checkpoint", "last"], ["--ckpt_path=last"], ["--ckpt", "last"]):
        call(act, "act", argv, ["checkpoint"])
    assert capsys.readouterr().out.splitlines() == ["last"] * 4


def test_one_of_several_functions_is_called_by_name_and_its_first_arguments_by_place(capsys):
    def copy(source: str, target: str, times: int = 1) -> int:
        """Copy something."""
        print(source, target, times)
        return 3

    functions = {"copy": (copy, ("source", "target"))}
    assert call_one_of(functions, "file", ["copy", "a", "b", "--times", "2"]) == 3
    assert capsys.readouterr().out == "a b 2\n"
    with pytest.raises(SystemExit):
        call_one_of(functions, "file", ["--help"])
    assert "ugr file copy        Copy something." in capsys.readouterr().out
    with pytest.raises(ConfigError, match="Did you mean `ugr file copy`"):
        call_one_of(functions, "file", ["cpy"])
    with pytest.raises(ConfigError, match="one of copy, got nothing"):
        call_one_of(functions, "file", [])


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--seeds", "[0,1]"], "seeds: expected evaluation, selection or a whole number, got [0, 1]."),
        (["--episodes", "0"], "episodes: expected a whole number above 0, got 0."),
        (["--episodes", "many"], "episodes: expected a whole number above 0, got many."),
        (["--pictures", "-1"], "pictures: expected a whole number, 0 or more, got -1."),
        (["--ratios", "half"], "ratios: expected a number or null, got half."),
        (["--size", "[1]"], "size: expected a tuple with 2 elements or null, got [1]."),
        (["--quick", "perhaps"], "quick: expected true or false, got perhaps."),
        (["--options", "3"], "options: expected a mapping, got 3."),
        (["--names", "high"], "names: expected a list, got high."),
        (["--numbers", "5.5"], "numbers: expected a whole number or a list, got 5.5."),
    ],
)
def test_a_wrong_value_is_told_in_words_and_not_in_types(words, says):
    def function(
        seeds: Literal["evaluation", "selection"] | int = 0,
        episodes: Count = 1,
        pictures: CountOrZero = 0,
        ratios: list[float] | None = None,
        size: tuple[int, int] | None = None,
        quick: bool = False,
        options: dict[str, int] = {},  # noqa: B006 - jsonargparse copies it
        names: tuple[str, ...] = (),
        numbers: int | tuple[int, ...] = 0,
    ) -> int:
        return 0

    with pytest.raises(ConfigError) as error:
        call(function, "try", words)
    assert str(error.value) == f"{says} Correct the value."


def test_what_is_missing_is_named(capsys):
    assert main(["export", "best"]) == 2
    assert "command line: expected --to, --out, got a command without. Add it" in capsys.readouterr().err
