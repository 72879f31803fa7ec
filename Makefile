# The front door. `make demo` and `make test` need nothing but Python 3.11 (or newer), make and a C compiler.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check -qq
INSTALLED := $(VENV)/installed
CPU_TORCH := https://download.pytorch.org/whl/cpu
PACKAGES := schemas labeling workers service

.DEFAULT_GOAL := help
.PHONY: help install demo format check openapi golden test test-data clean

help:  ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

install: $(INSTALLED)  ## Create .venv with everything the other targets need

# PyTorch goes first and alone: asked for by another package it would be the CUDA build, gigabytes of it. A wheel that
# pip already finds on this machine wins; else the CPU build of the same version.
$(INSTALLED): pyproject.toml constraints.txt deploy/system_libraries.py
	@$(PYTHON) deploy/system_libraries.py
	@echo "Creating $(VENV) (a minute or a few)"
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) install --no-deps --no-index -c constraints.txt torch 2>/dev/null \
		|| $(PIP) install --no-deps --extra-index-url $(CPU_TORCH) -c constraints.txt torch
	@$(PIP) install -c constraints.txt -e '.[s3,postgres,las,mcap,dev]'
	@touch $@

demo: install  ## Label a built-in street, evaluate it, draw a picture
	@rm -rf out/demo  # labels of older code would be in the way
	@$(BIN)/motionlabel demo

format: install  ## Rewrite the code in the one style
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

check: install  ## Style, types and import direction
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

openapi: install  ## Write docs/openapi.json anew
	@$(BIN)/python -c 'from service.app import render_openapi; print(render_openapi(), end="")' > docs/openapi.json

golden: install  ## Keep the labels of tests/golden anew, once LABEL_VERSION was raised
	@$(BIN)/python tests/golden/golden.py

test: install  ## All tests; those on real logs skip, and say so, where the logs are absent
	@$(BIN)/pytest -ra

test-data: install  ## Only the tests on real logs
	@$(BIN)/pytest -ra -m data

clean:  ## Remove the environment, caches and out/
	@rm -rf $(VENV) out build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	@find $(PACKAGES) tests -name __pycache__ -type d -prune -exec rm -rf {} +
