"""README.md and docs/: every command parses, every target, link, path and config exists, the site builds."""

import ast
import os
import re
import shlex
import subprocess
import sys

import pytest
from pages import DOCS, PAGES, ROOT, command_lines, overviews, read

from ugr_lightning.cli import main
from ugr_lightning.cli.parsing import call

PACKAGE = ROOT / "src" / "ugr_lightning"
RESULTS = sorted(path for path in (DOCS / "results").iterdir() if path.is_dir())
BASELINES = {"controls": ("--baseline", "uncert")}  # the other folders compare all pairs

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


class ParsedError(BaseException):
    """Ends a command once its options have been accepted; a BaseException, so that no command catches it."""


def ugr_commands() -> list[str]:
    """Every `ugr ...` of a code block, and those of the running text that have arguments, each once."""
    found: list[str] = []
    for path in PAGES:
        page = read(path)
        found += [line for line in command_lines(page) if re.match(r"ugr( |$)", line)]
        found += [span for span in page.spans if re.match(r"ugr \w+ .", span) and not re.search(r"\.\.\.|…", span)]
    found = [f"{line} --help" if re.fullmatch(r"ugr (data|bridge) \w+", line) else line for line in found]
    return list(dict.fromkeys(re.sub(r"\s+#.*", "", line) for line in found))


def save_own_files(folder):
    """What the extension tutorials tell their reader to save: `my_package`, and a config for each class in it."""
    (folder / "my_package").mkdir()
    (folder / "my_package" / "__init__.py").touch()
    for page in (DOCS / "extend").glob("*.md"):
        for name in re.findall(r"`((?:my_package/)?\w+\.(?:py|yaml))`", page.read_text()):
            language = {"py": "python", "yaml": "yaml"}[name.rpartition(".")[2]]
            (folder / name).write_text("\n".join(read(page).code(language)))
    for name in ("configs", "docs"):
        (folder / name).symlink_to(ROOT / name)


@pytest.mark.parametrize("line", ugr_commands())
def test_ugr_command_is_known_and_its_options_parse(line, tmp_path, monkeypatch, capsys):
    def stop(*_args, **_options):
        raise ParsedError

    monkeypatch.setattr(call.ArgumentParser, "instantiate_classes", stop)
    monkeypatch.setattr("ugr_lightning.cli.fit.UGRCLI._parse_ckpt_path", stop)
    save_own_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    words = shlex.split(line)[1:]
    if "--help" in words or "--print_config" in words:
        with pytest.raises(SystemExit) as ended:
            main.main(words)
        assert ended.value.code == 0
    else:
        with pytest.raises(ParsedError):
            assert main.main(words) is None, capsys.readouterr().err  # it ended by itself: 2 for wrong options


def test_a_flag_that_does_not_exist_is_found(tmp_path, monkeypatch, capsys):
    line = "ugr rollout --policy expert --not_a_flag 1"
    with pytest.raises(AssertionError, match="not_a_flag"):
        test_ugr_command_is_known_and_its_options_parse(line, tmp_path, monkeypatch, capsys)


@each_page
def test_every_subcommand_and_flag_of_the_text_is_known(page, monkeypatch, capsys):
    spans = read(page).spans
    named = {match[1] for span in spans if (match := re.match(r"ugr ([\w-]+)", span))}
    assert named <= main.COMMANDS.keys()
    flags = {flag for span in spans if span.startswith("--") for flag in re.findall(r"--[\w.]+", span)}
    if flags:
        options = ""
        commands = [[command] for command in main.COMMANDS]
        for command in commands:
            with pytest.raises(SystemExit):
                main.main([*command, "--help"])
            options += (shown := capsys.readouterr().out)
            commands += [[*command, name] for name in re.findall(rf"^  ugr {command[0]} (\w+)  ", shown, re.MULTILINE)]
        assert flags <= set(re.findall(r"--[\w.]+", options))


@each_page
def test_every_make_target_is_in_the_makefile(page):
    content = read(page)
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    lines = [*command_lines(content), *content.spans]
    named = {match[1] for line in lines if (match := re.match(r"make ([a-z]+)", line))}
    assert named <= targets


@each_page
def test_every_relative_link_leads_somewhere(page):
    for link in read(page).links:
        if re.match(r"[a-z]+:", link):
            continue  # the web
        target, _, heading = link.partition("#")
        place = page.parent / target if target else page
        assert place.exists(), f"{page.name} links to {link}"
        if heading:
            titles = re.findall(r"^#+ +(.+)$", place.read_text(), re.MULTILINE)
            anchors = [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]
            assert heading in anchors, f"{page.name} links to {link}"


@each_page
def test_every_path_of_the_repository_exists(page):
    content = read(page)
    texts = [*content.spans, *(block.text for block in content.blocks)]
    tops = "configs|docs|notebooks|scripts|src|tests"
    named = {path.rstrip("/.,") for text in texts for path in re.findall(rf"(?<![\w/.-])(?:{tops})/[\w/.*-]+", text)}
    for path in named:
        assert list(ROOT.glob(path)), f"{page.name} names {path}"
    for path in (span for span in content.spans if re.fullmatch(r"(?!my_)\w+(/\w+)*/\w+\.py", span)):
        assert (ROOT / path).is_file() or (PACKAGE / path).is_file(), f"{page.name} names {path}"


@each_page
def test_python_examples_are_valid(page):
    for block in read(page).blocks:
        if block.language == "python":
            ast.parse(block.text)


@pytest.mark.parametrize("folder", RESULTS, ids=lambda folder: folder.name)
def test_a_published_report_is_what_its_episodes_give(folder, capsys):
    assert main.main(["report", str(folder), *BASELINES.get(folder.name, ())]) == 0
    assert capsys.readouterr().out == (folder / "report.md").read_text()


@each_page
def test_tables_of_results_are_those_of_the_reports(page):
    text = page.read_text()
    for folder, table in overviews(text):
        report = (ROOT / folder / "report.md").read_text()
        whole = report.split("## Overview\n\n")[1].split("\n\n")[0].splitlines()
        entire = f"<!-- overview of {folder} -->" in text
        shown = [row for row in whole if entire or row in table.splitlines()]
        assert table.splitlines() == shown, f"`ugr report {folder}` prints it"
        assert len(shown) > 2
        assert shown[:2] == whole[:2], "what the columns are"


def test_each_published_report_is_shown_on_a_page():
    shown = {folder for page in PAGES for folder, _ in overviews(page.read_text())}
    assert shown == {str(folder.relative_to(ROOT)) for folder in RESULTS}


def test_messages_on_the_troubleshooting_page_are_those_of_the_package():
    """Quotes in bold open a paragraph; what they quote is text of an error, or a key."""
    source = " ".join(path.read_text() for path in PACKAGE.rglob("*.py"))
    quoted = re.findall(r"^\*\*`([^`]+)`", (DOCS / "install.md").read_text(), re.MULTILINE)
    assert len(quoted) > 10
    assert [message for message in quoted if message not in source] == []


def test_the_site_builds_without_a_broken_link_or_a_page_that_no_menu_has(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    reference = (tmp_path / "site" / "api" / "policies.html").read_text()
    assert "Predicts a chunk of actions from images and joints" in reference  # the docstring of ACT


def test_a_broken_link_fails_the_site(tmp_path):
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text("[nowhere](nowhere.md)")
    settings = (ROOT / "mkdocs.yml").read_text()
    start, end = settings.index("validation:"), settings.index("nav:\n")
    (tmp_path / "mkdocs.yml").write_text("site_name: x\nstrict: true\n" + settings[start:end])
    command = [sys.executable, "-m", "mkdocs", "build"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "nowhere.md" in done.stderr
