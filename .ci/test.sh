#!/usr/bin/env bash
# All tests with shapes checked, on as many cores as there are up to four; each process keeps to one thread.
set -euo pipefail
cd "$(dirname "$0")/.."
export OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1
exec .venv/bin/python -m pytest --check-shapes -n auto --maxprocesses 4 --dist worksteal "$@"
