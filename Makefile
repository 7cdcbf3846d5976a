# make demo | test | lint | bench: each builds its own environment in .venv from nothing.

PYTHON ?= python3
TORCH ?= torch==2.13.0
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: help install demo test lint format bench clean

help:
	@echo "make demo    blurry frames and events in, a sharp scene and its report out (runs/demo)"
	@echo "make test    the whole test suite, on all cores"
	@echo "make lint    ruff and pyright"
	@echo "make bench   time and memory of one training step, ours against the plain formulation"
	@echo "make clean   remove the environment and the caches"

install: $(STAMP)

# torch comes first and alone, so that no other package chooses its build. The build you get is your
# pip's choice; to force one: make install TORCH="torch==2.13.0+cpu --index-url <its index>"
$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "sharpfield needs Python 3.11 or newer."; \
		echo "  got  $$($(PYTHON) --version 2>&1) as $(PYTHON)"; \
		echo "  do   make PYTHON=python3.12 $(MAKECMDGOALS)"; \
		exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet $(TORCH)
	$(BIN)/python -m pip install --quiet --no-deps -r requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
	@touch $@

demo: $(STAMP)
	$(BIN)/sharpfield demo

test: $(STAMP)
	$(BIN)/python -m pytest -q -n auto

lint: $(STAMP)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright

format: $(STAMP)
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

bench: $(STAMP)
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache build src/*.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
