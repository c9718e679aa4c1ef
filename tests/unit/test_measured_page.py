"""Studies put what they measured into their page, and leave the rest of it alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from faults.measured_page import comments, write_measured

BEGIN, END = comments()


def test_what_stands_between_the_comments_is_replaced_and_nothing_else(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"# Before\n{BEGIN}\nold\n{END}\nafter\n")
    write_measured(page, "| new |")
    assert page.read_text() == f"# Before\n{BEGIN}\n| new |\n{END}\nafter\n"


@pytest.mark.parametrize("text", ["no comments\n", f"{BEGIN} alone\n"])
def test_a_page_without_its_comments_is_left_as_it_is(tmp_path: Path, text: str) -> None:
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(ValueError, match="lacks the lines"):
        write_measured(page, "| new |")
    assert page.read_text() == text


def test_a_page_has_several_tables_each_written_by_itself(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    (begin, end), first = comments("other"), "\n".join(comments("one"))
    page.write_text(f"{first}\n{begin}\nold\n{end}\n")
    write_measured(page, "| new |", "other")
    assert page.read_text() == f"{first}\n{begin}\n| new |\n{end}\n"
