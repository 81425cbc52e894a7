# Everything runs in .venv, which the first target that needs it sets up (several minutes, 5 GB: PyTorch).
PYTHON ?= python3.12
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DOCS_READY := $(VENV)/.docs_ready

.DEFAULT_GOAL := help
.PHONY: help setup demo test slow lint bench docs notebooks wheel

help:  ## Show the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 10

setup: $(READY)  ## Set up .venv with the package and its development tools

$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --upgrade pip
	$(BIN)/python -m pip install -e '.[dev]'
	touch $@

demo: $(READY)  ## Train BC, ZBC, WZBC in two mazes and on an arm, write outputs/demo/report.html (10 minutes)
	HF_HUB_OFFLINE=1 $(BIN)/lerobot-swr-demo --output_dir=outputs/demo

test: $(READY)  ## Run the fast tests (minutes)
	HF_HUB_OFFLINE=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile

slow: $(READY)  ## Run the tests that train policies to their full quality (an hour)
	HF_HUB_OFFLINE=1 $(BIN)/python -m pytest -m slow

lint: $(READY)  ## Check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(READY)  ## Print the benchmarks
	HF_HUB_OFFLINE=1 $(BIN)/python -m benchmarks

docs: $(DOCS_READY)  ## Build the documentation into build/site; broken links, unlisted pages, missing docstrings fail
	$(BIN)/ruff check --select D --ignore D105,D107 lerobot_swr
	$(BIN)/python -m docs.site.notebooks
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

notebooks: $(DOCS_READY)  ## Run the tutorials' notebooks (minutes)
	HF_HUB_OFFLINE=1 PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python -m docs.site.notebooks --run

$(DOCS_READY): $(READY)
	$(BIN)/python -m pip install -e '.[docs]'
	touch $@

wheel: $(READY)  ## Build wheel and source distribution into dist/ and check them
	rm -rf dist
	$(BIN)/python -m build
	$(BIN)/python -m twine check --strict dist/*
