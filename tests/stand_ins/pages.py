"""README.md and the pages of docs/, taken apart: code blocks, spans of code, links."""

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
DOCS = ROOT / "docs"
PAGES = [README, ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]


class Block(NamedTuple):
    language: str
    text: str


class Page(NamedTuple):
    blocks: list[Block]
    spans: list[str]
    links: list[str]

    def code(self, language: str) -> list[str]:
        """The text of its blocks in one language."""
        return [block.text for block in self.blocks if block.language == language]


def read(path: Path) -> Page:
    text = path.read_text()
    fence = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
    prose = fence.sub("", text)
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", prose)]
    return Page([Block(*found) for found in fence.findall(text)], spans, re.findall(r"\]\(([^)\s]+)\)", prose))


def command_lines(page: Page) -> list[str]:
    """Shell lines of the code blocks, continued lines joined, comments and `VAR=value` in front left out."""
    lines = [
        line.strip()
        for block in page.blocks
        if block.language in ("bash", "sh", "shell", "console")
        for line in block.text.replace("\\\n", " ").splitlines()
    ]
    return [re.sub(r"^(\$ +|[A-Z_]+=\S+ +)*", "", line) for line in lines]


def overviews(text: str) -> list[tuple[str, str]]:
    """The tables of results on a page, whole or some rows: the folder that a comment names, and the table under it."""
    return re.findall(r"<!-- (?:overview|rows) of (\S+) -->\n\n((?:\|.*\n)+)", text)
