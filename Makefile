# make demo   photos -> textured model of a made-up object, with its score; result in demo/
# make check  lint, types, who-may-import-whom, the quick tests: under a minute on two cores
# make test   all tests, shapes checked
# make trust  wrong input, kills, a full disk and attacks on the server: all of it, an hour on a core (docs/trust.md)
# make lowest the quick tests with the oldest versions that pyproject.toml admits
# make bench-smoke   two small scenes through the whole pipeline, their figures against committed ones
# make lint   formatting, lint, types, who-may-import-whom
# make image  the container of the Dockerfile, built and tried out
# make vendor the report's copies of three.js and Spark, from npm
# Each makes .venv first where needed.

PYTHON ?=
export PYTHON
BIN := .venv/bin

.PHONY: help venv demo check quick test trust lowest bench-smoke lint format docs image vendor clean

help:
	@sed -n 's/^# //p' Makefile

venv:
	@bash .ci/setup_env.sh

demo: venv
	$(BIN)/hineus demo

# Lint beside the tests, which have one thread a process: so two cores are busy all the time.
check: venv
	@$(MAKE) --no-print-directory -j2 --output-sync=target lint quick

quick: venv
	OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow" -n auto --maxprocesses 4

test: venv
	.ci/test.sh

trust: venv
	OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m pytest --whole tests/trust tests/test_view.py

lowest:
	.ci/lowest.sh

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
	$(BIN)/python -m docs.make_architecture
	$(BIN)/python -m benchmarks.pages

image:
	.ci/image.sh

# Bundled in a temporary folder: nothing of npm stays in the tree.
VENDOR := stages/templates/vendor
vendor:
	folder=$$(mktemp -d) && cp $(VENDOR)/*.entry.js $(VENDOR)/three.global.js $$folder/ && cd $$folder && \
	npm install --no-save three@0.187.0 @sparkjsdev/spark@2.2.0 esbuild@0.28.2 && \
	bundle() { node_modules/.bin/esbuild $$1.entry.js --bundle --minify --format=iife --global-name=$$2 --target=es2020 \
	  --outfile=$(CURDIR)/$(VENDOR)/$$1.min.js $$3 $$4; } && \
	bundle three THREE && \
	bundle spark SPARK --alias:three/addons=./node_modules/three/examples/jsm --alias:three=./three.global.js && \
	cp node_modules/three/LICENSE $(CURDIR)/$(VENDOR)/LICENSE && \
	cp node_modules/@sparkjsdev/spark/LICENSE $(CURDIR)/$(VENDOR)/LICENSE.spark && rm -r $$folder

clean:
	rm -rf .venv demo build dist *.egg-info
