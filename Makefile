# A newcomer runs `make demo` or `make test`, and nothing before it: both install what they need into .venv, once.

.DEFAULT_GOAL := help
.PHONY: help demo test check bench faults format clean install

BIN := .venv/bin
INSTALLED := .venv/.installed
TESTABLE := .venv/.installed-tests
# Test workers share the cores; what they start must not ask for all of them.
ONE_THREAD := NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1

help: ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-8s %s\n", $$1, $$2}' Makefile

demo: $(INSTALLED) ## four drones map a furnished room; the report lies in runs/latest
	@$(BIN)/covrecon run missions/demo.toml

# Tests that start processes share one worker (tests/conftest.py); the others fill the second core.
test: $(TESTABLE) ## all tests but the benchmarks
	@$(ONE_THREAD) $(BIN)/python -m pytest -n 2 --dist loadgroup --ignore tests/benchmarks

check: $(TESTABLE) ## formatting, lint, types, layers, dependencies: what CI checks before the tests
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-cache
	@$(BIN)/deptry .

bench: $(TESTABLE) ## the benchmarks, one after another; writes benchmarks.json and docs/benchmarks.md
	@rm -f benchmarks.json
	@$(ONE_THREAD) $(BIN)/python -m pytest tests/benchmarks
	@PYTHONPATH=.:tests $(BIN)/python -m faults.benchmarks_page

# Faults on real processes, one flight after another, and on a simulated network: about an hour.
faults: $(TESTABLE) ## what the system survives: every fault, random schedules; writes docs/reliability.md
	@$(ONE_THREAD) PYTHONPATH=.:tests $(BIN)/python -m faults.reliability

format: $(TESTABLE) ## rewrite the code in the common format, and the mission schema from the model
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .
	@$(BIN)/covrecon mission schema > protocol/mission.schema.json

install: $(TESTABLE) ## only what demo and test do first

clean: ## remove all that can be made again, but no runs
	@rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache build ./*.egg-info
	@find . -name __pycache__ -prune -exec rm -rf {} +

$(INSTALLED): pyproject.toml constraints.txt deploy/install.sh
	@deploy/install.sh
	@touch $@

$(TESTABLE): $(INSTALLED)
	@deploy/install.sh tests
	@touch $@
