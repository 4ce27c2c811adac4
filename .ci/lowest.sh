#!/usr/bin/env bash
# The quick tests with the oldest versions that pyproject.toml admits, in a virtual environment of their own, made anew.
# PyTorch is TORCH, which is not the oldest by default: for Linux, PyPI has that one with gigabytes of CUDA only.
# PYTHON=... chooses the interpreter, VENV=... the folder; arguments go to pytest: `.ci/lowest.sh tests/test_sfm.py`.
set -euo pipefail
cd "$(dirname "$0")/.."

PYTHON=${PYTHON:-python3.11} # all of the oldest versions have wheels for it
VENV=${VENV:-.venv-lowest}
TORCH=${TORCH:-2.13.0}

"$PYTHON" -m venv --clear "$VENV" # uv keeps what is there and new enough
"$VENV/bin/python" -m pip install -qq uv "torch==$TORCH"
"$VENV/bin/uv" pip install -q --python "$VENV" --resolution lowest-direct \
    --constraint <(echo "torch==$TORCH") --editable '.[dev]'
export OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1
NUMBA_CACHE_DIR=$(realpath "$VENV")/numba exec "$VENV/bin/python" -m pytest -m "not slow" -n auto --maxprocesses 4 "$@"
