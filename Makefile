# make run    set up, then train handkerchief flipping with two actors over an embedded router
# make test   set up, then run the tests
# make faults draw the fault matrix of docs/ (about half an hour; goes on where it was)
# make faults-of-imitation  the same for a run with discriminators
# make check  set up, then everything that CI holds: format, lint, types, imports, tests

PYTHON ?= python3.11
BIN := .venv/bin
READY := .venv/.ready
# Tests wait for processes much of the time: one more than there are processors.
TEST_PROCESSES ?= $(shell expr `nproc` + 1)

# CI adds minari, sb3 and viewers, whose programs read and drive what is ours in a few tests.
EXTRAS ?= dev

.PHONY: run test check bench faults faults-of-imitation clean

run: $(READY)
	$(BIN)/clothbus run handkerchief-quickstart --actors 2

test: $(READY)
	$(BIN)/pytest --numprocesses $(TEST_PROCESSES) --dist worksteal

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(MAKE) test

bench: $(READY)
	$(BIN)/pytest tests/benchmarks --override-ini addopts= -s

faults: $(READY)
	$(BIN)/python -m tests.faults.matrix --output docs/fault_matrix.md

faults-of-imitation: $(READY)
	$(BIN)/python -m tests.faults.matrix --scene imitation --output docs/fault_matrix_imitation.md

# torch by itself first and exactly: a plain "torch" would bring gigabytes of CUDA libraries.
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch==2.13.0
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[$(EXTRAS)]'
	touch $(READY)

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
