# One place for what people type: every target makes the environment first, and a second call finds it ready.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
TASK   ?= pointmaze-large-diverse
SEED   ?= 0
VENV   ?= .venv
BIN    := $(VENV)/bin
# One worker plays a whole file, so that the data and models its tests share are made once.
PYTEST_ARGS ?= -n auto --dist loadscope -m 'not faults'

.DEFAULT_GOAL := help
.PHONY: help demo test faults lint format audit figures notebooks notebooks-env clean

help:  ## show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## */\1|/' | awk -F'|' '{printf "  make %-14s %s\n", $$1, $$2}'

# The editable install sees later changes of the source; only new requirements install again.
$(VENV)/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo 'make: Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11' >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.[dev]' --constraint constraints.txt
	@touch $@

$(VENV)/.notebooks: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --editable '.[dev,notebooks]' --constraint constraints.txt
	@touch $@

demo: $(VENV)/.installed  ## all stages on PointMaze-Large, about ten minutes on two cores
	$(BIN)/dds run $(TASK) --seed $(SEED)

test: $(VENV)/.installed  ## the test suite
	$(BIN)/python -m pytest $(PYTEST_ARGS)

faults: $(VENV)/.installed  ## kill every stage at random moments, five minutes
	$(BIN)/python -m pytest -s tests/faults

lint: $(VENV)/.installed  ## ruff and mypy, changing nothing
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.installed  ## let ruff mend what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Not of the environment's own extras: who only trains and tests needs no auditor.
audit: $(VENV)/.installed  ## look every pinned version up among known vulnerabilities (needs a network)
	$(BIN)/python -m pip install --quiet 'pip-audit>=2.7' --constraint constraints.txt
	$(BIN)/pip-audit --requirement constraints.txt --no-deps --disable-pip --strict --progress-spinner off

notebooks: $(VENV)/.notebooks  ## execute all notebooks anew, under 45 minutes
	$(BIN)/python notebooks/execute.py

figures: $(VENV)/.installed  ## draw the figures of all shipped checkpoints anew
	$(BIN)/python benchmarks/draw_figures.py

notebooks-env: $(VENV)/.notebooks  ## add Jupyter to the environment

clean:  ## remove the environment and caches; runs/ stays
	rm -rf $(VENV) dist build .pytest_cache .ruff_cache .mypy_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
