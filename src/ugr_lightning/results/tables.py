"""Tables of texts, for a terminal and for Markdown."""

from collections.abc import Sequence

Cells = list[tuple[str, ...]]
"""A table, heading first."""


def as_text(cells: Sequence[Sequence[str]]) -> str:
    """Cells as an aligned table for the terminal."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
    return "\n".join([lines[0], "  ".join("-" * width for width in widths), *lines[1:]])


def as_markdown(cells: Sequence[Sequence[str]]) -> str:
    """Cells as a Markdown table."""
    head, *rows = cells
    escaped = [[cell.replace("|", "\\|") for cell in row] for row in (head, ["---"] * len(head), *rows)]
    return "\n".join(f"| {' | '.join(row)} |" for row in escaped)
