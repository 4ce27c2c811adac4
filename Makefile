# make demo   photos -> textured model of a made-up object, with its score; result in demo/
# make test   all tests
# make bench-smoke   a small scene through the whole pipeline, its figures against committed ones
# make lint   formatting, lint, types, who-may-import-whom
# Each makes .venv first where needed.

PYTHON ?=
export PYTHON
BIN := .venv/bin

.PHONY: help venv demo test bench-smoke lint format docs clean

help:
	@sed -n 's/^# //p' Makefile

venv:
	@bash .ci/setup_env.sh

demo: venv
	$(BIN)/hineus demo

test: venv
	$(BIN)/python -m pytest

bench-smoke: venv
	$(BIN)/python -m benchmarks.smoke

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: venv
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: venv
	$(BIN)/python docs/make_reference.py
	$(BIN)/python -m benchmarks.run_sets --table-only
	$(BIN)/python -m benchmarks.ablate --table-only
	$(BIN)/python -m benchmarks.hard_variants --table-only

clean:
	rm -rf .venv demo build dist *.egg-info
