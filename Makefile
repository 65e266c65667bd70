# make demo    set-up, then the embedded subject from clip to scores
# make test    set-up, then the lint and the tests, slow ones in part
# make test-all  installs what the optional tests need (root, Debian), then the lint and all tests in full
# make test-random  the tests in a random order; SEED=N: that order again
# make test-files   each test file by itself
# make setup   the set-up alone
# make chart   set-up, then speed against accuracy on the embedded subject (15 minutes); CASES=all SUBJECT=DIR: more
# make stress  set-up, then where Limn fails and whether it says so (an hour on one core; goes on where it was stopped)
# make audit   licences, changed files, bill of materials; ADVISORIES=all.zip: known vulnerabilities, too
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
INSTALL := $(BIN)/python -m pip install --quiet --require-hashes --no-deps --no-build-isolation
# Two files of tests at a time: together they take up to 4 GB.
SIDE_BY_SIDE := --numprocesses 2 --dist loadfile
CASES ?= quick
OUT ?= build/chart
SEED ?= $(shell date +%s)

.PHONY: setup demo test test-all test-random test-files chart stress lint audit clean

# Byte code beforehand, for those who may not write here and for containers: without it each stage compiles a hundred files.
setup: $(STAMP)
	$(BIN)/python -m compileall -q shared stages tools
	$(BIN)/python -m tools.setup.host
	$(BIN)/python -m tools.setup.models

# Every file is compared with its hash, but for CUDA's libraries, which only the package index's torch for Linux wants: it
# is taken where the CPU build is not to be had.
$(STAMP): requirements-build.lock requirements.lock requirements-torch-cpu.lock requirements-torch.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --requirement requirements-build.lock
	$(INSTALL) --requirement requirements.lock
	$(INSTALL) --requirement requirements-torch-cpu.lock || { \
	  echo "torch: its CPU build is not to be had (see docs/operators.md), so the package index's is taken"; \
	  $(INSTALL) --requirement requirements-torch.lock && $(BIN)/python -m pip install --quiet torch; }
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

demo: setup
	$(BIN)/python -m tools.demo

test: setup lint
	$(BIN)/python -m pytest $(SIDE_BY_SIDE)

test-all: setup lint
	$(BIN)/python -m tools.setup.test_all

test-random: setup
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) --order-seed $(SEED)

test-files: setup
	tools/setup/test_files.sh

chart: setup
	$(BIN)/python -m tools.bench.chart $(SUBJECT) --cases $(CASES) --out $(OUT)

stress: setup
	$(BIN)/python -m tools.bench.stress

lint: $(STAMP)
	$(BIN)/ruff check .

audit: $(STAMP)
	$(BIN)/python -m tools.setup.audit --sbom build/sbom.json $(if $(ADVISORIES),--advisories $(ADVISORIES))

clean:
	rm -rf demo build
