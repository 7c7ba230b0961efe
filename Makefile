# `make help` lists the targets. Everything is installed into .venv at the versions of constraints.txt.

PYTHON ?= python3
ARGS ?=
# Two workers with one thread each: more threads than cores make small tensor work slower, not faster.
JOBS ?= 2

VENV := .venv
BIN := $(VENV)/bin
PEERS := .venv-peers
# Scripts that start with an underscore are shared by the others.
BENCH ?= $(filter-out benchmarks/_%,$(wildcard benchmarks/*.py))

.DEFAULT_GOAL := help
.PHONY: help env env-dev env-bench env-peers demo test test-all lint format types bench clean distclean
# A recipe that fails half-way must not leave a stamp that says it is done.
.DELETE_ON_ERROR:

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*  ## \(.*\)/\1\t\2/p' $(MAKEFILE_LIST) | expand -t 12

# $(call create,FOLDER): a virtual environment, or one clear line that says why not.
define create
@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	echo "torchfilt needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) --version 2>/dev/null || echo missing)." \
	     "Name another: make PYTHON=python3.12" >&2; exit 1; }
@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	echo "'$(PYTHON)' can't make virtual environments: install its venv module (Debian: python3-venv)." >&2; exit 1; }
$(PYTHON) -m venv $(1)
endef

# $(call install,EXTRA): the package, editable, with an extra. No build isolation, because an isolated build would fetch
# a setuptools that nothing pins.
define install
@echo "installing torchfilt[$(1)] into $(VENV); the first time takes a minute or more"
@$(BIN)/python -m pip install -qq --constraint constraints.txt --upgrade pip setuptools wheel
@$(BIN)/python -m pip install -qq --constraint constraints.txt --no-build-isolation --editable '.[$(1)]' || { \
	echo "The install failed. If torch was not found, see the head of constraints.txt." >&2; exit 1; }
@$(BIN)/python -m pip check
@$(BIN)/python -c 'import torch; assert torch.version.cuda is None, f"not a CPU build: torch {torch.__version__}"'
@touch $@
endef

$(BIN)/python:
	$(call create,$(VENV))

$(VENV)/.stamp-demo: constraints.txt pyproject.toml | $(BIN)/python
	$(call install,demo)

$(VENV)/.stamp-dev: constraints.txt pyproject.toml | $(BIN)/python
	$(call install,dev)
	@touch $(VENV)/.stamp-demo

$(VENV)/.stamp-bench: constraints.txt pyproject.toml | $(BIN)/python
	$(call install,demo$(comma)bench)
	@touch $(VENV)/.stamp-demo

comma := ,

$(PEERS)/.stamp: requirements-peers.txt
	$(call create,$(PEERS))
	@$(PEERS)/bin/python -m pip install -qq --requirement requirements-peers.txt
	@$(PEERS)/bin/python -m pip check
	@touch $@

env: $(VENV)/.stamp-demo  ## .venv with the library and what the demo needs
env-dev: $(VENV)/.stamp-dev  ## .venv with the tools of developers too
env-bench: $(VENV)/.stamp-bench  ## .venv with the libraries that the benchmarks compare with
env-peers: $(PEERS)/.stamp  ## .venv-peers: compared libraries that need NumPy < 2

demo: env  ## run the demo; its output goes to runs/demo (ARGS="...")
	$(BIN)/python scripts/demo.py $(ARGS)

test: env-dev  ## run the tests but the slow ones (ARGS="-k kalman")
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) $(ARGS)

test-all: env-dev  ## run all tests, slow ones too
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) -m "" $(ARGS)

lint: env-dev  ## check style and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: env-dev  ## rewrite the sources in the project's format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: env-dev  ## check types
	$(BIN)/mypy torchfilt

bench: env-bench  ## run the benchmarks (BENCH=benchmarks/one.py ARGS="...")
	@for script in $(BENCH); do echo "== $$script"; $(BIN)/python "$$script" $(ARGS) || exit 1; done

clean:  ## remove caches and build output
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -path './.venv*' -prune -o -type d -name __pycache__ -prune -exec rm -rf {} +

distclean: clean  ## remove the environments too
	rm -rf $(VENV) $(PEERS)
