from __future__ import annotations

import importlib
import importlib.metadata
import sys
from pathlib import Path

import pytest

from protocol.errors import ProcessError
from protocol.guard import PACKAGES, ROOT, require_own_packages

OURS = "coverage-recon"


@pytest.mark.parametrize("name", PACKAGES)
def test_a_package_is_imported_from_this_tree(name: str) -> None:
    module = importlib.import_module(name)

    assert module.__file__ is not None
    assert Path(module.__file__).parent == ROOT / name


@pytest.mark.parametrize("name", PACKAGES)
def test_no_other_distribution_installs_our_names(name: str) -> None:
    owners = importlib.metadata.packages_distributions().get(name, [OURS])

    assert set(owners) == {OURS}


def test_every_package_of_the_tree_is_guarded() -> None:
    assert {path.parent.name for path in ROOT.glob("*/__init__.py")} == set(PACKAGES)


def test_the_guard_accepts_this_tree() -> None:
    require_own_packages()


def test_the_guard_names_a_foreign_package_and_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "__init__.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "agents", raising=False)

    with pytest.raises(ProcessError, match=f"'agents' would come from {tmp_path}.*PYTHONPATH={ROOT}"):
        require_own_packages()
