#!/usr/bin/env bash
# Make or bring up to date the virtual environment .venv: system libraries, PyTorch (a small CPU build where there
# is no NVIDIA GPU), the project itself with its development tools. Quick when nothing changed.
# PYTHON=... chooses the interpreter, VENV=... the folder.
set -euo pipefail
cd "$(dirname "$0")/.."

VENV=${VENV:-.venv}
TORCH=torch==2.13.0 # the version the figures in docs/benchmarks were measured with
TORCH_CPU_INDEX=https://download.pytorch.org/whl/cpu
STAMP=$VENV/.ready

say() { printf '%s\n' "setup: $*" >&2; }
fail() { say "$*"; exit 1; }

can_install() { [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; }

apt_install() {
    say "installing with apt-get: $*"
    apt-get update -qq >/dev/null 2>&1 || true # an old list may still do
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}

# Shared libraries that open3d, pymeshlab and pycolmap load, and the Debian package of each.
system_libraries() {
    command -v ldconfig >/dev/null || return 0 # not Linux: the wheels bring theirs
    local present missing=() pair
    present=$(ldconfig -p)
    for pair in libGL.so.1=libgl1 libEGL.so.1=libegl1 libOpenGL.so.0=libopengl0 libX11.so.6=libx11-6 \
        libusb-1.0.so.0=libusb-1.0-0 libidn2.so.0=libidn2-0 libatomic.so.1=libatomic1 libgomp.so.1=libgomp1; do
        [[ $present == *"${pair%%=*}"* ]] || missing+=("${pair##*=}")
    done
    [ ${#missing[@]} = 0 ] && return 0
    if can_install; then
        apt_install "${missing[@]}"
    else
        say "missing system libraries; install them with: sudo apt-get install -y ${missing[*]}"
    fi
}

# xatlas has wheels for CPython 3.10 to 3.13.
find_python() {
    local candidate
    for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11 python3.10}; do
        if command -v "$candidate" >/dev/null &&
            "$candidate" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then
            echo "$candidate"
            return 0
        fi
    done
    fail "no Python from 3.10 to 3.13 was found; install one, or name it: make ${1:-venv} PYTHON=/path/to/python3.13"
}

make_venv() {
    local python=$1
    "$VENV/bin/python" -m pip --version >/dev/null 2>&1 && return 0
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        if can_install; then
            apt_install python3-venv
        else
            fail "$python has no venv module; install it with: sudo apt-get install -y python3-venv"
        fi
    fi
    say "making $VENV with $("$python" --version)"
    "$python" -m venv --clear "$VENV"
}

has_gpu() { command -v nvidia-smi >/dev/null && nvidia-smi -L 2>/dev/null | grep -q GPU; }

reachable() {
    "$VENV/bin/python" - "$1" <<'PY' 2>/dev/null
import sys, urllib.request
urllib.request.urlopen(sys.argv[1], timeout=4).close()
PY
}

install_torch() {
    "$VENV/bin/python" -c 'from importlib.metadata import version; version("torch")' 2>/dev/null && return 0
    local index=()
    if [ "$(uname -s)" = Linux ] && ! has_gpu && reachable "$TORCH_CPU_INDEX/torch/"; then
        index=(--index-url "$TORCH_CPU_INDEX") # the default index has the CUDA build: gigabytes that a CPU cannot use
    fi
    say "installing $TORCH ${index[*]}"
    "$VENV/bin/python" -m pip install -qq "${index[@]}" "$TORCH"
}

wanted=$(cat pyproject.toml .ci/setup_env.sh | cksum)
if [ -f "$STAMP" ] && [ "$(cat "$STAMP")" = "$wanted" ]; then
    exit 0
fi
started=$SECONDS
python=$(find_python)
system_libraries
make_venv "$python"
install_torch
say "installing the project and its tools"
"$VENV/bin/python" -m pip install -qq --editable '.[dev]'
echo "$wanted" >"$STAMP"
say "ready in $((SECONDS - started)) s"
