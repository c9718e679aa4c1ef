"""Where studies leave what they measured: between two comments of a page."""

from __future__ import annotations

from pathlib import Path

MEASURED = "measured"


def comments(what: str = MEASURED) -> tuple[str, str]:
    """Before and after it."""
    return f"<!-- {what}: begin -->", f"<!-- {what}: end -->"


def write_measured(page: Path, measured: str, what: str = MEASURED) -> None:
    """Put ``measured`` in the place of what stands between the comments; ``what``: which, of a page with several.
    Raises `ValueError` where they are not."""
    begin, end = comments(what)
    before, begins, rest = page.read_text().partition(begin)
    _, ends, after = rest.partition(end)
    if not (begins and ends):
        raise ValueError(f"{page}: lacks the lines {begin} and {end}, between which the results come")
    page.write_text(f"{before}{begin}\n{measured}\n{end}{after}")
