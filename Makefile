# Everything starts here: `make` lists the targets.
.DEFAULT_GOAL := help
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.DELETE_ON_ERROR:

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEMO_STAMP := $(VENV)/.demo
# Two test processes with one thread each suit a small machine; more cores: make test WORKERS=8.
WORKERS ?= 2
DATA ?= data/synthetic
DEMO_DATA := data/demo
RUN ?= outputs/demo/seed_0
# What a report is about: runs, sweeps, or folders of them.
DIRS ?= $(if $(filter-out file,$(origin RUN)),$(RUN),outputs)
ARGS ?=
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Empty: commands and tests start many processes, and each would compile every module that it imports.
export PYTHONDONTWRITEBYTECODE :=
# Bytecode of what a command imports is made when it does; of everything that is installed it takes half a minute.
INSTALL = $(BIN)/python -m pip install -q --no-compile -c constraints.txt
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
# Each process begins with one stretch of the files and then takes from the others, so that few files are set up twice.
PYTEST := $(ONE_THREAD) $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

.PHONY: help install test test-slow test-types test-notebooks docs results lint format data demo train evaluate simulate report benchmark clean

help: ## Show this text
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-14s %s\n", $$1, $$2}'

install: $(STAMP) ## Create .venv with the tested versions (again only after a change of pyproject.toml or constraints.txt)

$(STAMP): pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) -e ".[dev]"
	touch $@

# What the demo needs, a fraction of it all; where everything is installed, that serves.
$(DEMO_STAMP): pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) -e ".[synth,view]"
	touch $@

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "error: no python3.11 or python3 found. Install Python 3.11 to 3.13, or: make install PYTHON=/path/to/python" >&2; exit 1; }
	"$(PYTHON)" -c 'import sys; assert (3, 11) <= sys.version_info < (3, 14), f"expected Python 3.11 to 3.13, got {sys.version.split()[0]}. Use make install PYTHON=/path/to/python3.11"'
	"$(PYTHON)" -m venv $(VENV)
	$(BIN)/python -m pip install -q --upgrade pip  # recent ones choose versions in half the time

test: install ## Run the default tests (without the slow ones)
	$(PYTEST) -m "not slow" $(ARGS)

test-slow: install ## Run the slow tests
	$(PYTEST) -m slow $(ARGS)

test-types: install ## Run the default tests with every annotated type and shape checked at run time (twice the time)
	GAUSIM_CHECK_TYPES=1 $(PYTEST) -m "not slow" $(ARGS)

# The first, second and fourth share a trained run; the third trains its own sweep beside them.
test-notebooks: install ## Execute the notebooks on the embedded synthetic data
	run() { $(ONE_THREAD) $(BIN)/python -m pytest -p nbmake --nbmake --nbmake-timeout=600 "$$@"; }
	run notebooks/03_*.ipynb & third=$$!
	failed=0; run notebooks/01_*.ipynb notebooks/02_*.ipynb notebooks/04_*.ipynb || failed=1
	wait $$third
	exit $$failed

docs: install results ## Build the documentation into site/ (serve it: .venv/bin/mkdocs serve)
	$(BIN)/python -c "import material, mkdocstrings" 2>/dev/null || $(INSTALL) -e ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

results: install ## Make docs/results.md from its records (docs/results/, which `gausim report DIR --record` writes)
	$(BIN)/python docs/results/make.py
	$(BIN)/python docs/figures.py

lint: install ## Check style, formatting, types, import directions and declared dependencies
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/deptry .

format: install ## Format the code and fix what can be fixed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

data: $(DATA)/.made ## Make the synthetic data set

$(DATA)/.made: | install
	$(BIN)/gausim prepare synthesize --out $(DATA)
	touch $@

train: install ## Train: make train ARGS="data=demo seed=1"
	$(BIN)/gausim train $(ARGS)

evaluate: install ## Evaluate a run: make evaluate RUN=outputs/demo/seed_0
	$(BIN)/gausim evaluate $(RUN) $(ARGS)

simulate: install ## Write the videos and figures of a run: make simulate RUN=outputs/demo/seed_0
	$(BIN)/gausim simulate $(RUN) $(ARGS)

report: install ## Tables, figures and videos: make report DIRS="outputs/a outputs/b" (RUN=DIR for one)
	$(BIN)/gausim report $(DIRS) $(ARGS)

benchmark: install ## Measure: make benchmark ARGS=step (alone: every case at tiny sizes, to see that it works)
	$(BIN)/python -m benchmarks $(or $(ARGS),all --quick)

demo: $(DEMO_DATA)/.made ## From nothing to a simulator that predicts: install, make an object, train, evaluate, and a page about it
	test -e outputs/demo/seed_0/FINISHED || $(BIN)/gausim train data=demo plan.epochs=1
	$(BIN)/gausim export outputs/demo/seed_0 --format page --out outputs/demo/seed_0/page.html & page=$$!
	$(BIN)/gausim evaluate outputs/demo/seed_0
	wait $$page
	$(BIN)/gausim report outputs/demo/seed_0

$(DEMO_DATA)/.made: | $(if $(wildcard $(STAMP)),$(STAMP),$(DEMO_STAMP))
	$(BIN)/gausim prepare synthesize --objects gerbera --sequences 4 --kernels 12000 --resolution 256 --out $(DEMO_DATA)
	touch $@

clean: ## Remove caches and builds (not .venv, data or outputs)
	rm -rf build dist site .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
	find src tests data_prep benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
