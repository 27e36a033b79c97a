# Every target sets up what it needs first; see `make help`.
SHELL := /bin/bash
.DEFAULT_GOAL := help

export PYTHON ?= python3.11
export VENV ?= .venv
export TORCH_INDEX ?= auto
JOBS ?= 2
ARGS ?=
BIN := $(VENV)/bin
PACKAGES := $(VENV)/.packages-installed
RENDERER := $(VENV)/.renderer-works

.PHONY: help setup demo test fuzz evidence lint docs speed doctor lock clean

help:  ## list the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):[^#]*## /  make \1\t/' | expand -t 16
	@echo "Variables: PYTHON, VENV, JOBS (test processes), ARGS (added to the command), TORCH_INDEX (auto, none or a wheel index)"

setup: $(RENDERER)  ## virtual environment, pinned packages, software Vulkan driver where none works

demo: setup  ## record, train, evaluate and explain a two-arm policy
	$(BIN)/ugr demo $(ARGS)

# Simulators are single-threaded and each test file keeps its own, so files are spread over processes.
test: setup  ## run the tests
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) --dist loadfile $(ARGS)

fuzz: setup  ## damage files of every format at random and read them; minutes
	$(BIN)/python -m pytest tests/fuzz_readers.py $(ARGS)

evidence: setup  ## kill, fill, lock and double what writes, and see; most of an hour, goes on where it was stopped
	$(BIN)/python tests/evidence $(ARGS)

lint: $(PACKAGES)  ## ruff check, ruff format --check, mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(PACKAGES)  ## build this documentation into build/docs; a broken link fails
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

speed: setup  ## measure the speed ratios of docs/performance.md on this machine
	$(BIN)/ugr speed $(ARGS)

doctor: setup  ## what works on this machine, and what to do about the rest
	$(BIN)/ugr doctor

lock: $(PACKAGES)  ## resolve pyproject.toml anew into requirements.lock
	$(BIN)/python scripts/lock.py

clean:  ## remove the environment and caches; never data/ or runs/
	rm -rf $(VENV) build dist .cache .pytest_cache .ruff_cache .mypy_cache
	find src tests scripts -name __pycache__ -type d -prune -exec rm -rf {} +

$(PACKAGES): requirements.lock pyproject.toml scripts/setup_env.sh
	@scripts/setup_env.sh
	@touch $@

# The script makes the stamp, and only when rendering works: without a driver every call looks again.
$(RENDERER): $(PACKAGES) scripts/setup_vulkan.sh
	@scripts/setup_vulkan.sh $@
