# The commands of this project; `make help` lists them.
#
# Where the default package registry would give a CUDA build of torch that is not wanted, name an
# index that holds another build of the same version:  make venv TORCH_INDEX=https://...
# It is used for torch alone.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
TORCH_INDEX ?=

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

# Each benchmarks/NAME.py is a study, run as `python -m benchmarks.NAME`; files whose name starts
# with an underscore are not studies.  A single one:  make bench STUDIES=speed
STUDIES ?= $(patsubst benchmarks/%.py,%,$(sort $(wildcard benchmarks/[a-z]*.py)))

# Further arguments for pytest:  make test ARGS='-k driving'
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help venv demo check test docs bench results tables format clean
.DELETE_ON_ERROR:

help: ## List these commands
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-8s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

venv: $(STAMP) ## Build .venv with the exact versions of constraints.txt

# torch goes first, in a call of its own and pinned: asked for as a range next to everything else,
# it may come as a CUDA build of several gigabytes.  Its dependencies come with the second call, so
# that they are held by constraints.txt whatever TORCH_INDEX has.
# -qq leaves pip's errors alone.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/pip install -qq --no-deps $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) \
		$$(grep '^torch==' constraints.txt)
	$(BIN)/pip install -qq -c constraints.txt -e '.[dev]'
	@touch $@

demo: $(STAMP) ## Fit ten simulated drivers who differ, in fog; results in runs/demo
	$(BIN)/python -m mirror_ppl.fit --domain driving --setting fog --population diverse --out runs/demo

check: $(STAMP) ## Style, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

# One thread a process: the networks are small, and two workers share the cores.
test: $(STAMP) ## The whole test suite
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal $(ARGS)

docs: $(STAMP) ## The documentation site in build/site; a broken link or reference fails
	$(BIN)/sphinx-build --fresh-env --quiet --fail-on-warning --keep-going -c docs/_site -d build/doctrees \
		. build/site

bench: $(STAMP) ## Every study in benchmarks/, one after the other
	@set -e; for study in $(STUDIES); do \
		echo "== $$study"; $(BIN)/python -m benchmarks.$$study; \
	done

results: $(STAMP) ## The paper's comparisons in all domains; hours; results in runs/results
	worst=0; for study in prediction assistance relevance; do \
		$(BIN)/python -m mirror_ppl.evaluate $$study \
			--domain driving search_rescue bomb_defusal --out runs/results || worst=$$?; \
	done; exit $$worst

include benchmarks/highway.mk

tables: $(STAMP) ## Pages and tables of docs/results.md from the rows in docs/results
	$(BIN)/python -m benchmarks.tables

format: $(STAMP) ## Sort imports, apply safe fixes, format
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

clean: ## Remove caches and build outputs (not .venv, not runs/)
	rm -rf build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name .venv -prune -o -type d \( -name __pycache__ -o -name .ipynb_checkpoints \) \
		-prune -exec rm -rf {} +
