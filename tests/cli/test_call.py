from ugr_lightning.cli.call import call


def test_a_yes_or_no_option_works_as_a_plain_flag(capsys):
    def act(quick: bool = False, count: int = 1) -> int:
        """Act."""
        print(quick, count)
        return 0

    for argv in (["--quick", "--count", "3"], ["--quick"], ["--quick", "false"], []):
        call(act, "act", argv)
    assert capsys.readouterr().out.splitlines() == ["True 3", "True 1", "False 1", "False 1"]
