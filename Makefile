# Needs Python 3.10 to 3.13 and make; the environment is made on first use, in .venv.
PYTHON ?= python3
VENV ?= .venv
RUN := $(VENV)/bin/python

.DEFAULT_GOAL := help
.PHONY: help demo test lint format benchmark environment clean

help: ## list the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

demo: $(VENV)/.stamp ## run the whole method on a generated case, into build/demo (under 15 minutes on two cores)
	$(RUN) -m ExpectedAppearancesLib demo --out build/demo

test: lint ## lint, then run every test
	$(RUN) -m pytest

lint: $(VENV)/.stamp ## check style and format
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .

format: $(VENV)/.stamp ## apply style and format
	$(RUN) -m ruff check --fix .
	$(RUN) -m ruff format .

benchmark: $(VENV)/.stamp ## measure each stage beside its plain reference, into build/benchmark.json
	$(RUN) Testing/benchmarks/run.py

environment: $(VENV)/.stamp ## make the Python environment only

clean: ## remove the environment and everything that was built
	rm -rf $(VENV) build *.egg-info .pytest_cache .ruff_cache

# The stamp is written last: an installation that was interrupted starts again.
$(VENV)/.stamp: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' || \
	  { echo "Python 3.10 to 3.13 is needed; $(PYTHON) is another version. Use: make PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || \
	  { echo "The venv module is incomplete. On Debian or Ubuntu: sudo apt-get install python3-venv"; exit 1; }
	$(RUN) -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev,scene]'
	@touch $@
