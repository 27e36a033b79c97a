from ugr_lightning.cli.call import call, name_leading


def test_a_yes_or_no_option_works_as_a_plain_flag(capsys):
    def act(quick: bool = False, count: int = 1) -> int:
        """Act."""
        print(quick, count)
        return 0

    for argv in (["--quick", "--count", "3"], ["--quick"], ["--quick", "false"], []):
        call(act, "act", argv)
    assert capsys.readouterr().out.splitlines() == ["True 3", "True 1", "False 1", "False 1"]


def test_leading_arguments_get_the_names_of_options():
    assert name_leading(["a", "b", "--x", "1"], ["first", "second"]) == ["--first", "a", "--second", "b", "--x", "1"]
    assert name_leading(["a", "--x", "1"], ["first", "second"]) == ["--first", "a", "--x", "1"]
    assert name_leading(["--first", "a"], ["first"]) == ["--first", "a"]
    assert name_leading(["a", "stray"], ["first"]) == ["--first", "a", "stray"], "and is then refused by the parser"
