# make setup: .venv with everything. make check: lint and the core of the suite. make test: lint and the whole suite. make notebooks: they run, and so do the blocks of the README and of the pages. make demo: one picture.
# make docs: the site in site/, to be opened from there.
# Nothing but Python is needed.
# make results: every figure that a page tells, measured anew: hours, and nothing else may run meanwhile. It goes on where it was
# interrupted; `python benchmarks/run_all.py --list` says what each part takes, and how old its result is.
SHELL := /bin/bash
VENV := .venv
PYTHON ?=
# Processes that share the suite, file by file, those that take longest first; 0 runs all in one.
JOBS ?= 2
PYTEST_ARGS ?=
# With this JAX compiles once what several tests or benchmarks compile, in any process, as long as the folder is there: single
# operations, too, thousands of which take a thirtieth of a second each.
SHARE_COMPILED = JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0 JAX_COMPILATION_CACHE_DIR
PIP := $(VENV)/bin/python -m pip -qq --disable-pip-version-check

.PHONY: setup check test test-slow test-slow-share test-nightly test-endurance notebooks lint format demo docs results clean

setup: $(VENV)/.installed-all

# The first interpreter that is new enough, starts, and can make an environment: a shim on the PATH may do none of it.
$(VENV)/.python:
	@for candidate in $(PYTHON) python3.13 python3.12 python3.11 python3 python3.14 /usr/bin/python3; do \
		if "$$candidate" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then \
			echo "making $(VENV) with $$candidate"; \
			rm -rf $(VENV) && "$$candidate" -m venv $(VENV) && $(PIP) install --upgrade pip && touch $@ && exit 0; \
		fi; \
	done; \
	echo "no working Python 3.11 or newer found (with venv and pip); name one: make $(MAKECMDGOALS) PYTHON=/path/to/python3" >&2; exit 1

$(VENV)/.installed-test: pyproject.toml | $(VENV)/.python
	@echo "installing jaxsph[test] into $(VENV)"
	@$(PIP) install --editable '.[test]'
	@touch $@

$(VENV)/.installed-all: pyproject.toml | $(VENV)/.python
	@echo "installing jaxsph[all] into $(VENV)"
	@$(PIP) install --editable '.[all]'
	@touch $(VENV)/.installed-test $@

$(VENV)/.installed-docs: pyproject.toml | $(VENV)/.python
	@echo "installing jaxsph[docs] into $(VENV)"
	@$(PIP) install --editable '.[docs]'
	@touch $@

# What the tests compile is kept for the next run: `make clean` or another COMPILED begins anew.
COMPILED ?= $(VENV)/compiled-tests
SUITE = compiled=$$($(VENV)/bin/python tests/shared/kept_programs.py $(COMPILED) $(JOBS)) && $(SHARE_COMPILED)=$$compiled \
	$(VENV)/bin/python -m pytest -q -n $(JOBS) --dist loadfile --no-loadscope-reorder
# The whole suite is held to what it may compile (tests/programs.json); other numbers of processes share fewer programs or more.
ALL_OF_IT = $(if $(PYTEST_ARGS),,$(if $(filter 0 1 2,$(JOBS)),--hold-programs=tests/programs.json))

# Linters run beside the tests.
check: $(VENV)/.installed-test
	@$(MAKE) --no-print-directory -j2 lint suite-of-check

test: $(VENV)/.installed-test
	@$(MAKE) --no-print-directory -j2 lint suite-of-test

.PHONY: suite-of-check suite-of-test
suite-of-check:
	@$(SUITE) -m core $(PYTEST_ARGS)

suite-of-test:
	@$(SUITE) $(ALL_OF_IT) $(PYTEST_ARGS)

test-slow: $(VENV)/.installed-test
	@$(SUITE) -m 'not endurance' $(PYTEST_ARGS)

# The slow ones too, with ten times the examples, other ones each time, and nothing compiled before.
test-nightly: $(VENV)/.installed-test
	@rm -rf $(VENV)/compiled-tests
	@$(SUITE) -m 'not endurance' --hypothesis-profile=nightly --timeout 3600 $(PYTEST_ARGS)

# Of the tests marked slow, a part that changes with every commit, so that all have their turn in as many runs as there are parts;
# of a shallow clone, whose commits cannot be counted, with every hour.
SLOW_PARTS ?= 12
SLOW_RUN ?= $(shell [ "$$(git rev-parse --is-shallow-repository 2>/dev/null)" = false ] && git rev-list --count HEAD || echo $$(( $$(date -u +%s) / 3600 )))
SLOW_SECONDS ?= 200
test-slow-share: $(VENV)/.installed-test
	@echo "run $(SLOW_RUN): one in $(SLOW_PARTS) of the tests marked slow, none begun after $(SLOW_SECONDS) s"
	@$(SUITE) -m slow --share=$(SLOW_RUN)/$(SLOW_PARTS) --budget=$(SLOW_SECONDS) $(PYTEST_ARGS)

test-endurance: $(VENV)/.installed-test
	@$(VENV)/bin/python -m pytest -q --timeout 0 -m endurance $(PYTEST_ARGS) tests/test_endurance.py

notebooks: $(VENV)/.installed-test
	@$(SUITE) -m notebook $(PYTEST_ARGS) tests/test_notebooks.py tests/test_docs.py tests/test_site.py

lint: $(VENV)/.installed-test
	@$(VENV)/bin/ruff check --quiet --output-format concise .
	@$(VENV)/bin/ruff format --check --quiet . || { echo "formatting differs: make format" >&2; exit 1; }
	@$(VENV)/bin/mypy --no-error-summary
	@$(VENV)/bin/lint-imports --no-cache > $(VENV)/lint-imports.log || { cat $(VENV)/lint-imports.log; exit 1; }

format: $(VENV)/.installed-test
	@$(VENV)/bin/ruff check --quiet --fix-only .
	@$(VENV)/bin/ruff format --quiet .

demo: $(VENV)/.installed-all
	@$(VENV)/bin/jaxsph demo -o demo

# Warnings are errors, and links are followed; nothing of it needs a network.
docs: $(VENV)/.installed-docs
	@$(VENV)/bin/python -m sphinx -q -W --keep-going -E -b html -c docs -d build/doctrees . build/html
	@rm -rf site && mv build/html site
	@$(VENV)/bin/python docs/check_site.py site

# PARTS names some of them; DATA is a folder of particle files, PEER_PYTHON a Python that has sarracen. Parts that need more than
# is there are left out, by name.
PARTS ?=
DATA ?=
PEER_PYTHON ?=
results: $(VENV)/.installed-all
	@$(PIP) install --editable '.[all,vtk,peers]'
	@$(VENV)/bin/python benchmarks/run_all.py $(if $(DATA),--data '$(DATA)') $(if $(PEER_PYTHON),--peer-python '$(PEER_PYTHON)') $(PARTS)

clean:
	rm -rf $(VENV) build dist site .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache demo.exr demo.png
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
