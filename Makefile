# `make demo` and `make test` are all that a newcomer needs; `make help` lists the rest.
# They work with nothing but python3 (>= 3.11) with venv and pip. Another interpreter: make PYTHON=python3.12 demo

PYTHON ?= python3
VENV   ?= .venv

BIN      := $(VENV)/bin
PLAIN    := $(VENV)/.installed-plain
EDITABLE := $(VENV)/.installed-editable
DOCS     := $(VENV)/.installed-docs
# With these versions of the libraries the tests passed: a new release of one turns no test red before it is taken here.
TESTED_WITH := tests/constraints.txt
SOURCES  := pyproject.toml README.md $(shell find aftbed dbc -type f -not -name '*.pyc')

# The tests without real runs take every core: those of one thing each, which are run while one edits, then whole
# commands, searches and drives. Of real runs, each has a core for either replica: two at a time are as many as two
# cores bear without false alarms. A file stays together, for the runs that its tests share; a page of the docs, whose
# commands are run, is a unit of its own. They are taken in the order of collection, the small files last. Only files
# that have tests of their kind are read: each worker imports them all.
FAST := -n auto --dist worksteal -m "not simulation and not process and not deep" \
  $(sort $(shell grep -rL --include='test_*.py' '^pytestmark = pytest.mark.\(process\|simulation\)$$' tests))
SIMULATION := -n auto --dist worksteal -m "simulation and not process and not deep" \
  $(sort $(shell grep -rl --include='test_*.py' mark.simulation tests))
TWO_AT_A_TIME := -n 2 --dist loadgroup --no-loadscope-reorder -m "process and not deep"
PAGES := tests/docs/test_commands.py
REAL := $(TWO_AT_A_TIME) $(filter-out $(PAGES),$(sort $(shell grep -rl --include='test_*.py' mark.process tests)))

FAULT := crash primary at checkpoint.sent nth 100

# Hundreds of interpreters start in the tests; without bytecode each would compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo test lint fast simulation process pages noisy deep mutants bench soak docs pictures constraints
.NOTPARALLEL:
.DELETE_ON_ERROR:

help:
	@echo "make demo        install into $(VENV), drive a car whose server's primary is killed on the way"
	@echo "make test        install with the tools of the tests, then lint, fast, simulation and process"
	@echo "make lint        ruff check, ruff format --check, mypy"
	@echo "make fast        the tests of one thing each, a minute: while one edits"
	@echo "make simulation  the tests that simulate many runs or drives: whole commands, searches, planted bugs"
	@echo "make process     the tests that start real runs: a sample of their combinations"
	@echo "make pages       every command of README.md and docs/, run as it stands there: a CI's, after make test"
	@echo "make noisy       all of these beside bursts of other work on every core, as root: which test needs a quiet machine?"
	@echo "make deep        the exhaustive tests, and thousands of examples of every property: hours"
	@echo "make docs        the pages of docs/ as a site: build/docs/index.html"
	@echo "make pictures    the pictures of the README, of runs that it makes (ONLY=page: that one; with Chromium and tmux)"
	@echo "make mutants     plant bugs one by one, see what notices them, write docs/assumptions.md (ONLY=words: some, print)"
	@echo "make constraints the newest libraries into tests/constraints.txt: then make test, and commit it"
	@echo "make soak        one run of 30 minutes with a crash every 2 s, an adaptation every 5 s: does anything grow?"
	@echo "make bench       every figure of docs/numbers.md, written into its table: 25 minutes (PASSES=10: ten times; OLD=VENV: then compare with it)"

# Where the tests are installed, the package is too: then the demo needs nothing more.
demo: $(if $(wildcard $(EDITABLE)),$(EDITABLE),$(PLAIN))
	$(BIN)/aftbed run --ftm pbr --scenario ccrs-50 --pace real --inject "$(FAULT)"

test: lint fast simulation process

lint: $(EDITABLE)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

fast: $(EDITABLE)
	$(BIN)/python -m pytest $(FAST)

simulation: $(EDITABLE)
	$(BIN)/python -m pytest $(SIMULATION)

process: $(EDITABLE)
	$(BIN)/python -m pytest $(REAL)

pages: $(EDITABLE)
	$(BIN)/python -m pytest $(TWO_AT_A_TIME) $(PAGES)

noisy: $(EDITABLE)
	$(BIN)/python tests/noise.py $(MAKE) --keep-going fast simulation process pages

deep: $(EDITABLE)
	$(BIN)/python -m pytest -m deep
	$(BIN)/python -m pytest -n auto --hypothesis-profile deep --timeout 0 -m "hypothesis and not process and not deep"

mutants: $(EDITABLE)
	$(BIN)/python tests/mutation/run_mutants.py --into docs/assumptions.md $(if $(ONLY),--only "$(ONLY)")

bench: $(EDITABLE)
	$(BIN)/aftbed bench all --into docs/numbers.md $(if $(PASSES),--passes $(PASSES))
	$(if $(OLD),$(BIN)/aftbed bench compare "$(OLD)" $(VENV))

soak: $(EDITABLE)
	$(BIN)/aftbed bench soak --minutes 30 --rate 500 --crash-every 2 --adapt-every 5

docs: $(DOCS)
	$(BIN)/python -m sphinx -W --keep-going -E -q -b html -d build/doctrees -c docs . build/docs
	@echo "build/docs/index.html"

pictures: $(EDITABLE)
	$(BIN)/python tests/docs/make_pictures.py $(ONLY)

# From an environment of its own, with what a new user gets today.
constraints:
	$(PYTHON) -m venv --clear build/newest
	build/newest/bin/python -m pip install --quiet --disable-pip-version-check -e ".[test]"
	@echo "# The versions of the libraries with which the tests pass. To take the newest: make constraints" > $(TESTED_WITH)
	build/newest/bin/python -m pip list --disable-pip-version-check --format=freeze --exclude aftbed --exclude pip --exclude setuptools >> $(TESTED_WITH)

# -- installation: a stamp each, so that a second `make` installs only what has changed ------------

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit("aftbed needs Python 3.11 or newer, found " + sys.version.split()[0] + "; name another one: make PYTHON=python3.12" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)

$(PLAIN): $(SOURCES) | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check .
	@rm -f $(EDITABLE)
	@touch $@

$(EDITABLE): pyproject.toml $(TESTED_WITH) | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(TESTED_WITH) -e ".[test]"
	@rm -f $(PLAIN)
	@touch $@

$(DOCS): pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[docs]"
	@rm -f $(PLAIN)
	@touch $@
