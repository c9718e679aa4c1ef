"""Where studies leave what they measured: between two comments of a page."""

from __future__ import annotations

from pathlib import Path

BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"


def write_measured(page: Path, measured: str) -> None:
    """Put ``measured`` in the place of what stands between the comments. Raises `ValueError` where they are not."""
    before, begins, rest = page.read_text().partition(BEGIN)
    _, ends, after = rest.partition(END)
    if not (begins and ends):
        raise ValueError(f"{page}: lacks the lines {BEGIN} and {END}, between which the results come")
    page.write_text(f"{before}{BEGIN}\n{measured}\n{END}{after}")
