# Every target that needs the environment sets it up first; a complete set-up costs a moment.
# GNU make 3.81 is enough. Give pytest more words with ARGS, as in: make test ARGS="-k lens"

PYTHON ?= python3
ARGS ?=
# Files of tests side by side, on all cores up to four: each process loads Mitsuba. In the order of folders: the
# longest first.
SIDE_BY_SIDE := -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

ifeq ($(OS),Windows_NT)
BIN := .venv/Scripts
else
BIN := .venv/bin
endif

# Side by side, threads of BLAS only wait for each other: a fit of a rail takes three times the processor time with two.
test verify: export OPENBLAS_NUM_THREADS ?= 1

.PHONY: help setup demo test verify lint docs bench clean

help:
	@echo "make setup   make .venv, install the pinned packages, find a usable LLVM"
	@echo "make demo    render and evaluate scenes/arena.yaml into outputs/arena"
	@echo "make test    the tests, without the long statistical checks"
	@echo "make verify  the long statistical checks; with AT_LENGTH=1 also those that say the same again"
	@echo "make lint    ruff, mypy, and the site: warnings are errors"
	@echo "make docs    the site, in docs/_build/html/index.html; it opens offline"
	@echo "make bench   every benchmark, one JSON object each"
	@echo "make clean   remove .venv and the tools' caches; outputs stay"

setup:
	@command -v "$(PYTHON)" >/dev/null || { echo "setup: error: there is no $(PYTHON): install the package python3-venv (Python 3.11 or newer)" >&2; exit 1; }
	@"$(PYTHON)" tools/bootstrap.py

demo: setup
	$(BIN)/nir-render run scenes/arena.yaml -o outputs/arena --overwrite

test: setup
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) -m "not verify" $(ARGS)

# Status 5 is pytest's for "no test was selected".
verify: setup
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) -m verify $(ARGS) || [ $$? -eq 5 ]

lint: setup docs
	$(BIN)/python -m ruff check
	$(BIN)/python -m ruff format --check
	$(BIN)/python -m mypy

# Read anew each time: pages follow from the program too.
docs: setup
	rm -rf docs/_build docs/reference
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html

bench: setup
	@set -e; for file in benchmarks/*.py; do \
		if [ -f "$$file" ]; then PYTHONPATH=. $(BIN)/python -P "$$file"; fi; \
	done

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis build dist docs/_build docs/reference
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
