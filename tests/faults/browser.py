"""The browser in which tests open pages: the one that `deploy/install.sh` looks for, without a display or a GPU."""

from __future__ import annotations

import shutil

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next(filter(None, map(shutil.which, NAMES)), "")
"""Its path; empty if there is none."""
OPTIONS = ("--no-sandbox", "--enable-unsafe-swiftshader")

needs_browser = pytest.mark.skipif(not BROWSER, reason=f"there is no browser: none of {', '.join(NAMES)}")
