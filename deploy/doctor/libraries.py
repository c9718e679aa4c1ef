"""Whether the libraries are there, as new as they must be, and can be loaded.

What must be there is what ``pyproject.toml`` says; an installed copy, which has none, asks its own metadata. Loading
happens in a process of its own: a library that was built for another processor takes its process with it.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from deploy.doctor.finding import Finding
from protocol.guard import ROOT

DISTRIBUTION = "coverage-recon"
LOAD_S = 120.0
"""What all libraries together may take to load; Open3D alone takes seconds on a busy computer."""
MARK = "covrecon-loaded\t"
"""Begins the probe's own lines: libraries print too."""
PROBE = f"""
import importlib, sys
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
        fault = ""
    except BaseException as error:
        fault = " ".join(f"{{type(error).__name__}}: {{error}}".split())
    print("\\n{MARK}" + fault, flush=True)
"""

DEBIAN_PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libgl1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}
"""Of system libraries that wheels link to (`deploy/install.sh` installs them too)."""
INSTALL = "run: make install"


@dataclass(frozen=True, slots=True)
class Library:
    requirement: Requirement
    extra: str
    """Which optional set asks for it; empty: everybody needs it."""
    version: str
    """Installed; empty: it is not."""
    modules: tuple[str, ...]
    """What to import of it."""


def required_libraries(root: Path = ROOT) -> list[Library]:
    """All that apply to this kind of computer. Raises `PackageNotFoundError` when it cannot be known."""
    providers = _modules_by_distribution()
    found = []
    for extra, line in _requirement_lines(root):
        requirement = Requirement(line)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        try:
            version = metadata.version(requirement.name)
        except metadata.PackageNotFoundError:
            version = ""
        found.append(Library(requirement, extra, version, providers.get(canonicalize_name(requirement.name), ())))
    return found


def _requirement_lines(root: Path) -> Iterator[tuple[str, str]]:
    """Extra and requirement of each line."""
    try:
        project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    except FileNotFoundError:
        own = metadata.metadata(DISTRIBUTION)
        extras = ("", *(own.get_all("Provides-Extra") or ()))
        for line in metadata.requires(DISTRIBUTION) or ():
            marker = Requirement(line).marker
            yield next((extra for extra in extras if marker is None or marker.evaluate({"extra": extra})), ""), line
        return
    for line in project["dependencies"]:
        yield "", line
    for extra, lines in project["optional-dependencies"].items():
        for line in lines:
            yield extra, line


def _modules_by_distribution() -> dict[str, tuple[str, ...]]:
    """What to import of each installed distribution: the module of its own name, or else all that it brings."""
    modules: dict[str, set[str]] = defaultdict(set)
    for module, names in metadata.packages_distributions().items():
        for name in names:
            modules[canonicalize_name(name)].add(module)
    chosen = {}
    for name, brought in modules.items():
        own = name.replace("-", "_")
        chosen[name] = (own,) if own in brought else tuple(sorted(brought))
    return chosen


def check_libraries(libraries: Sequence[Library], needed: Mapping[str, str]) -> Iterator[Finding]:
    """One finding for each set of libraries, and one for each library that is not as it must be.

    Args:
        libraries: as `required_libraries` returns them.
        needed: why a set is needed, by extra; a set that is not there and not needed is no fault.
    """
    faults = load([module for library in libraries if library.version for module in library.modules])
    for extra in dict.fromkeys(library.extra for library in libraries):
        members = [library for library in libraries if library.extra == extra]
        subject = f"libraries [{extra}]" if extra else "libraries"
        if extra and not any(library.version for library in members):
            yield _absent(subject, extra, needed.get(extra, ""))
            continue
        wrong = [finding for library in members for finding in _check(library, faults)]
        yield from wrong
        if not wrong:
            yield Finding(subject, "ok", f"{len(members)} there, each new enough and fit to be loaded")


def _absent(subject: str, extra: str, why: str) -> Finding:
    if why:
        return Finding(subject, "fail", f"not installed, but {why}", f"run: .venv/bin/pip install -e '.[{extra}]'")
    return Finding(subject, "ok", "not installed, and not needed")


def _check(library: Library, faults: Mapping[str, str]) -> Iterator[Finding]:
    name, wanted = library.requirement.name, str(library.requirement.specifier)
    if not library.version:
        yield Finding(name, "fail", f"not installed; {wanted} is needed", INSTALL)
        return
    if not library.requirement.specifier.contains(library.version, prereleases=True):
        yield Finding(name, "fail", f"version {library.version}, but {wanted} is needed", INSTALL)
    for module in library.modules:
        if faults[module]:
            yield Finding(name, "fail", f"cannot be loaded: {faults[module]}", remedy(faults[module]))


def remedy(fault: str) -> str:
    """What to do about a library that cannot be loaded."""
    missing = re.search(r"(lib[\w.+-]+?\.so[.\d]*)", fault)
    if missing is None:
        return "install it anew: make clean install"
    package = DEBIAN_PACKAGES.get(missing[1])
    if package is None:
        return f"install the system's package that holds {missing[1]}"
    return f"run: sudo apt-get install -y --no-install-recommends {package}"


def load(modules: Sequence[str], timeout_s: float = LOAD_S) -> dict[str, str]:
    """What went wrong when each of ``modules`` was imported; empty where nothing did."""
    faults: dict[str, str] = {}
    left = list(modules)
    while left:
        told, end = _probe(left, timeout_s)
        faults |= dict(zip(left, told, strict=False))
        left = left[len(told) :]
        if left:
            faults[left.pop(0)] = end
    return faults


def _probe(modules: Sequence[str], timeout_s: float) -> tuple[list[str], str]:
    """What the probe said of the modules that it got through, and how it ended at the next one."""
    command = [sys.executable, "-P", "-c", PROBE, *modules]
    try:
        process = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=timeout_s, check=False
        )
        output, code = process.stdout, process.returncode
        end = f"its process was killed by {signal.Signals(-code).name}" if code < 0 else f"it ends its process ({code})"
    except subprocess.TimeoutExpired as error:
        output, end = error.stdout or b"", f"not loaded after {timeout_s:g} s"
    lines = output.decode(errors="replace").splitlines()
    return [line.removeprefix(MARK) for line in lines if line.startswith(MARK)], end
