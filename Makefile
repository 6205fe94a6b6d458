# One place for what people type: every target makes the environment first, and a second call finds it ready.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
TASK   ?= pointmaze-large-diverse
SEED   ?= 0
VENV   ?= .venv
BIN    := $(VENV)/bin
# The versions that an environment is made of.
CONSTRAINTS ?= constraints.txt
# One worker plays a whole file, so that the data and models its tests share are made once.
PYTEST_ARGS ?= -n auto --dist loadscope -m 'not faults'

.DEFAULT_GOAL := help
.PHONY: help bench demo test test-oldest test-python pin-oldest faults lint format audit figures notebooks notebooks-env clean

help:  ## show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## */\1|/' | awk -F'|' '{printf "  make %-14s %s\n", $$1, $$2}'

# The editable install sees later changes of the source; only new requirements install again.
$(VENV)/.installed: pyproject.toml $(CONSTRAINTS)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo 'make: Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11' >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.[dev]' --constraint $(CONSTRAINTS)
	@touch $@

$(VENV)/.notebooks: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --editable '.[dev,notebooks]' --constraint $(CONSTRAINTS)
	@touch $@

demo: $(VENV)/.installed  ## all stages on PointMaze-Large, three to seven minutes on two cores
	$(BIN)/dds run $(TASK) --seed $(SEED)

test: $(VENV)/.installed  ## the test suite
	$(BIN)/python -m pytest $(PYTEST_ARGS)

test-oldest:  ## the test suite with the oldest versions that pyproject.toml allows
	$(MAKE) test VENV=$(VENV)-oldest CONSTRAINTS=constraints-oldest.txt

test-python:  ## the test suite on another interpreter: make test-python PYTHON=python3.13
	$(MAKE) test VENV=$(VENV)-$(notdir $(PYTHON))

# uv resolves to the lowest versions. torch brings its own exact NVIDIA packages where a CUDA build is chosen.
pin-oldest: $(VENV)/.installed  ## rewrite constraints-oldest.txt after changing a lower bound (needs a network)
	$(BIN)/python -m pip install --quiet uv
	{ sed -n '/^#/p' constraints-oldest.txt; \
	  grep '^torch==' constraints.txt | $(BIN)/uv pip compile pyproject.toml --all-extras --quiet --no-header --no-annotate \
	    --resolution lowest-direct --python-version 3.11 --constraint - | grep -vE '^(nvidia|cuda|triton)'; } \
	  >constraints-oldest.tmp
	mv constraints-oldest.tmp constraints-oldest.txt

faults: $(VENV)/.installed  ## kill every stage at random moments, read mutated files; twenty minutes
	$(BIN)/python -m pytest -s tests/faults

lint: $(VENV)/.installed  ## ruff and mypy, without changing files
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/.installed  ## let ruff fix what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Other packages are measured where they are installed: pip install -e '.[peers]' -c constraints.txt
bench: $(VENV)/.installed  ## how fast each training is, beside the processor's limit and other packages
	$(BIN)/python benchmarks/bench.py

# Not in an extra: training and testing do not need an auditor.
audit: $(VENV)/.installed  ## look every pinned version up among known vulnerabilities (needs a network)
	$(BIN)/python -m pip install --quiet 'pip-audit>=2.7' --constraint constraints.txt
	$(BIN)/pip-audit --requirement constraints.txt --no-deps --disable-pip --strict --progress-spinner off

notebooks: $(VENV)/.notebooks  ## execute all notebooks again, under 45 minutes
	$(BIN)/python notebooks/execute.py

figures: $(VENV)/.installed  ## redraw the figures of all shipped checkpoints
	$(BIN)/python benchmarks/draw_figures.py

notebooks-env: $(VENV)/.notebooks  ## add Jupyter to the environment

clean:  ## remove the environment and caches; runs/ stays
	rm -rf $(VENV) $(VENV)-* dist build .pytest_cache .ruff_cache .mypy_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
