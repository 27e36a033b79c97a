import re

import pytest

from ugr_lightning.cli import doctor
from ugr_lightning.cli.doctor import Finding
from ugr_lightning.cli.main import main
from ugr_lightning.sim.render import RenderProbe


@pytest.fixture
def no_renderer(monkeypatch):
    """A machine without Vulkan, so that nothing is rendered here."""
    monkeypatch.setattr(doctor, "probe_rendering", lambda: RenderProbe(False, "", "Install a driver."))


def test_a_missing_renderer_fails_with_advice_and_training_is_said_to_work(no_renderer, capsys):
    assert main(["doctor"]) == 1
    said = capsys.readouterr().out
    assert re.search(r"^fail +Vulkan device .*-> Install a driver\.$", said, re.MULTILINE)
    assert "Training works" in said


def test_everything_that_the_package_needs_has_a_plain_line(no_renderer, capsys):
    main(["doctor"])
    said = capsys.readouterr().out
    for what in ("Python", "PyTorch", "precision", "Lightning", "SAPIEN", "ManiSkill", "Vulkan", "disk", "memory"):
        assert re.search(rf"^(ok|warn|fail) +{what}", said, re.MULTILINE), what
    *lines, last = said.splitlines()
    assert "\x1b" not in said
    assert all(re.match(r"(ok|warn|fail)  ", line) for line in lines)
    assert last.startswith(f"{len(lines)} checks: ")


def test_a_warning_alone_does_not_fail_and_brackets_are_no_markup(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "CHECKS", (lambda: iter([Finding("warn", "disk", "little [bold]", "free some")]),))
    assert main(["doctor"]) == 0
    said = ["warn  disk  little [bold]  -> free some", "1 checks: 0 failed, 1 with a warning"]
    assert capsys.readouterr().out.splitlines() == said


@pytest.mark.parametrize(("fast", "status", "picked"), [(True, "ok", "bf16"), (False, "warn", "fp32")])
def test_precision_says_what_auto_picks(monkeypatch, fast, status, picked):
    monkeypatch.setattr(doctor, "bf16_is_fast", lambda device: fast)
    finding = next(item for item in doctor.check_torch() if item.what == "precision")
    assert (finding.status, finding.found.split()[2]) == (status, picked)


def test_a_package_that_is_not_installed_fails_with_the_command_that_installs_it():
    finding = doctor._package("Nothing", "no-such-distribution", None)
    assert finding.status == "fail"
    assert "make setup" in finding.advice


def test_a_full_disk_and_little_memory_are_warned_about(monkeypatch):
    monkeypatch.setattr(doctor, "DISK_GIB", 1e9)
    monkeypatch.setattr(doctor, "MEMORY_GIB", 1e9)
    findings = list(doctor.check_resources())
    assert [finding.status for finding in findings] == ["warn", "warn"]
    assert all(finding.advice for finding in findings)


@pytest.mark.renders
def test_a_picture_is_rendered_and_its_path_printed(tmp_path):
    from PIL import Image

    path = tmp_path / "picture.png"
    finding = doctor._picture(path)
    assert finding.status == "ok"
    assert str(path) in finding.found
    with Image.open(path) as picture:
        assert picture.size == (3 * 320, 240)
        assert len(picture.getcolors(maxcolors=picture.width * picture.height)) > 20


def test_a_renderer_that_kills_its_process_is_a_finding_and_not_a_crash(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor, "PICTURE_PROGRAM", "import os; os.abort()")
    finding = doctor._picture(tmp_path / "picture.png")
    assert (finding.status, finding.found) == ("fail", "exit code -6")
