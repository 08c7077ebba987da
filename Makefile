# handsim's chores. Each target makes .venv by itself, once, and anew when its makings change.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
DEVELOPER := $(VENV)/.developer
# What --painter opengl needs on Debian and Ubuntu: EGL, OpenGL and Mesa's software driver.
DRAWING_PACKAGES := libegl1 libegl-mesa0 libgl1-mesa-dri libgl1 libopengl0

export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Two test processes whose matrices are small lose a third of their time to OpenBLAS's threads, which wait for one another.
export OPENBLAS_NUM_THREADS ?= 1
# Commands that tests start would compile every module anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow lint format fuzz fuzz-coverage tables results chaos truth docs dist clean drawing

help:  ## list the targets (this)
	@echo "usage: make TARGET [PYTHON=python3.12]"
	@sed -n 's/^\([a-z-]*\):.*  ## \(.*\)/  \1\t\2/p' $(MAKEFILE_LIST)

demo: $(INSTALLED)  ## run the whole chain on a built-in example, into demo/
	$(BIN)/handsim demo --out demo

test: $(DEVELOPER) drawing lint  ## lint, and every test that is quick
	@$(BIN)/handsim doctor --compile >/dev/null
	$(BIN)/pytest -n 2 --dist loadgroup --max-worker-restart 0 --durations 20 -m "not slow" -o faulthandler_timeout=600

test-slow: $(DEVELOPER) drawing  ## the other tests
	$(BIN)/pytest -n 2 --dist loadgroup --max-worker-restart 0 --durations 20 -m slow

lint: $(DEVELOPER)  ## style, format, types and the order of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(DEVELOPER)  ## put the code into its format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

fuzz: $(DEVELOPER)  ## damaged files for every reader: CASES=20000 of each, TARGET=c3d for one
	$(BIN)/python -m tests.fuzzing --cases $(or $(CASES),20000) $(if $(TARGET),--target $(TARGET))

fuzz-coverage: $(DEVELOPER)  ## the same by coverage: MOST=600 seconds of each, TARGET=c3d for one; installs atheris
	$(BIN)/pip install --quiet --constraint constraints.txt atheris
	$(BIN)/python -m tests.fuzzing.coverage --seconds $(or $(MOST),600) $(if $(TARGET),--target $(TARGET))

chaos: $(DEVELOPER)  ## kill every long command at random moments and run it again; KILLS=20
	$(BIN)/python -m tests.chaos --kills $(or $(KILLS),20)

docs: $(DEVELOPER)  ## the guide, the commands and the API reference, into build/docs
	$(BIN)/sphinx-build -W --keep-going -q -j 2 docs build/docs

dist: $(DEVELOPER)  ## the wheel and the source archive of this commit, made twice to compare, into dist/
	PYTHON=$(abspath $(BIN))/python .ci/dist

tables: $(DEVELOPER)  ## print the paper's tables beside ours, half an hour; ONLY=table5 for one
	for table in $(or $(ONLY),table3 table4 table5 table6 cameras calibrated); do \
	  OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.paper $$table || exit 1; done

results: $(DEVELOPER)  ## write docs/results.md and docs/trust.md from the figures in benchmarks/figures
	$(BIN)/python -m benchmarks.results

truth: $(DEVELOPER)  ## the tracker on real hands in motion: DATA=path of Mocap_SIG18_Data
	@test -d "$(DATA)" || { echo "make truth needs DATA, the path of a folder of Mocap_SIG18_Data"; exit 1; }
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.real_motion $(DATA)

clean:  ## remove .venv, caches and what the demo wrote
	rm -rf $(VENV) demo docs/api docs/help build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# setuptools goes in first so that the build needs no isolated environment with versions of its own.
$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; (3, 11) <= sys.version_info < (3, 14) or sys.exit(1)' || { \
	  echo "handsim needs Python 3.11, 3.12 or 3.13 and '$(PYTHON)' is none of them; try make PYTHON=python3.12"; exit 1; }
	@echo "making $(VENV): one to ten minutes (CONTRIBUTING.md says how to get torch's CPU build)"
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/pip install --quiet --constraint constraints.txt setuptools
	$(BIN)/pip install --quiet --constraint constraints.txt --no-build-isolation --editable .
	@touch $@

$(DEVELOPER): $(INSTALLED)
	@echo "adding what developers need"
	$(BIN)/pip install --quiet --constraint constraints.txt --no-build-isolation --editable '.[dev]'
	@touch $@

drawing:
	@dpkg --status $(DRAWING_PACKAGES) >/dev/null 2>&1 || { \
	  test "$$(id -u)" = 0 && command -v apt-get >/dev/null && apt-get update -qq && \
	  DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $(DRAWING_PACKAGES); } || \
	  echo "Tests of the OpenGL painter need EGL and OpenGL, and skip without them; to run them, have root run" \
	    "'apt-get install $(DRAWING_PACKAGES)' or install your system's counterparts."
