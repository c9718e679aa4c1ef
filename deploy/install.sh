#!/usr/bin/env bash
# Installs Coverage-Recon into .venv: what `make` does before anything else. Debian 12, Ubuntu 24.04.
# With "tests" as argument also what its tests and checks need.
set -euo pipefail
cd "$(dirname "$0")/.."

# What Open3D's wheel needs from the system, and the Debian packages that hold it.
LIBRARIES=(libEGL.so.1 libGL.so.1 libusb-1.0.so.0)
LIBRARY_PACKAGES=(libegl1 libgl1 libusb-1.0-0)

# Test programs open the console in a browser; without one they say so and are left out.
BROWSERS=(chromium chromium-browser google-chrome)

fail() {
    printf 'install: %s\n' "$@" >&2
    exit 1
}

find_python() {
    local name
    for name in ${PYTHON:-python3 python3.13 python3.12 python3.11}; do
        if "$name" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            command -v "$name"
            return
        fi
    done
}

# Debian splits venv off python3.
has_venv() { "$1" -c 'import ensurepip, venv' 2>/dev/null; }

missing_packages() {
    local python=$1 known index
    [[ -n $python ]] || echo python3
    { [[ -n $python ]] && has_venv "$python"; } || echo python3-venv
    known=$(PATH=$PATH:/sbin:/usr/sbin ldconfig -p 2>/dev/null || true)
    for index in "${!LIBRARIES[@]}"; do
        grep -qF "${LIBRARIES[index]}" <<<"$known" || echo "${LIBRARY_PACKAGES[index]}"
    done
}

install_system_packages() {
    local line="apt-get install -y --no-install-recommends $*"
    command -v apt-get >/dev/null || fail "missing on this system: $*" "(Debian's names; install them and run make again)"
    [[ $(id -u) == 0 ]] || fail "missing on this system: $*" "run this once, then make again:" "  sudo $line"
    echo "install: system packages: $*"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive $line -qq >/dev/null
}

# pip's output cut down to the downloads that take time.
large_downloads() { sed -un 's/^ *Downloading \([^ ]*\) (\([0-9.]* MB\)).*/install:   \1 \2/p'; }

# What tests wish for and do not need: what cannot be had is told. $1: package, $2: tests that are left out without it.
install_wished() {
    local line="apt-get install -y --no-install-recommends $1"
    if [[ $(id -u) == 0 ]] && command -v apt-get >/dev/null; then
        echo "install: system packages: $1"
        if apt-get update -qq && DEBIAN_FRONTEND=noninteractive $line -qq >/dev/null; then
            return
        fi
    fi
    echo "install: no $1: tests of $2 are left out; to run them:  sudo $line"
}

install_browser() {
    local name
    for name in "${BROWSERS[@]}"; do
        if command -v "$name" >/dev/null; then
            return
        fi
    done
    install_wished chromium "the console"
}

# Network namespaces, in which one machine stands for many; for root alone.
install_hosts() { PATH=$PATH:/sbin:/usr/sbin command -v ip >/dev/null || install_wished iproute2 "many hosts"; }

# Torch is for tests of the learned reconstructor, and comes only where it is found built for the CPU: 200 MB to fetch,
# 750 MB on disk.
install_torch() {
    local tool=(.venv/bin/python -m pip install --disable-pip-version-check) found
    if command -v uv >/dev/null; then
        tool=(uv pip install --python .venv/bin/python)
    fi
    tool+=(--constraint constraints.txt --editable '.[learned]')
    if found=$("${tool[@]}" --dry-run 2>&1) && ! grep -Eqi 'nvidia|cuda' <<<"$found"; then
        "${tool[@]}" --quiet && return
    fi
    echo "install: no torch for the CPU alone: tests of the learned reconstructor are left out"
}

# $1: python, then what to install.
install_packages() {
    local python=$1
    shift
    if command -v uv >/dev/null; then
        # uv does not read pip's settings.
        export UV_FIND_LINKS=${UV_FIND_LINKS-${PIP_FIND_LINKS-$("$python" -m pip config get global.find-links 2>/dev/null || true)}}
        uv venv --quiet --allow-existing --python "$python" .venv
        uv pip install --quiet --python .venv/bin/python --constraint constraints.txt "$@"
    else
        "$python" -m venv .venv
        # --group came with pip 25.1.
        .venv/bin/python -m pip install --quiet --disable-pip-version-check 'pip>=25.1'
        # Setuptools' warning about editable installs is for others than `make`'s users.
        PYTHONWARNINGS=ignore .venv/bin/python -m pip install --disable-pip-version-check --progress-bar off \
            --constraint constraints.txt "$@" | large_downloads
    fi
}

python=$(find_python)
[[ -n $python || -z ${PYTHON:-} ]] || fail "PYTHON=$PYTHON is no Python 3.11 or newer"
mapfile -t missing < <(missing_packages "$python")
if ((${#missing[@]})); then
    install_system_packages "${missing[@]}"
    python=$(find_python)
fi
[[ -n $python ]] || fail "Python 3.11 or newer is needed, and python3 is $(python3 --version 2>&1 || true)" \
    "name another one: make PYTHON=/path/to/python"
has_venv "$python" || fail "$python has no venv module: install it, or name another: make PYTHON=/path/to/python"

if [[ ${1:-} == tests ]]; then
    install_browser
    install_hosts
    echo "install: test tools, about 2.5 GB more"
    install_packages "$python" --editable '.[ground,camera,lidar,mocap]' --group dev
    install_torch
else
    echo "install: about 1 GB into .venv, once; a few minutes"
    install_packages "$python" --editable '.[ground,camera]'
fi
echo "install: done"
