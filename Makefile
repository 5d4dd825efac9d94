# Everything is installed into .venv, with the versions of .ci/constraints.txt. `make` lists the targets.

PYTHON ?= python3
# The newest one that is tested; pyenv keeps it outside the path.
PYTHON_NEWEST ?= $(lastword python3.13 $(wildcard $(HOME)/.pyenv/versions/3.13.*/bin/python))
VENV := .venv
PY := $(VENV)/bin/python
CONSTRAINTS := .ci/constraints.txt
LOWEST := .ci/constraints_lowest.txt
EXTRAS := neural,baselines,app,distributed,loggers,peers,dev
# Tests of what other packages do for this one: tables, formulas, units, fits, reports, workers.
OTHERS := $(addprefix tests/test_,tables.py logger_files.py units.py model.py identify.py sweeps.py report.py)
# Bytecode is left to the first use of a module: compiling all that is installed takes longer than installing it.
PIP_INSTALL := -m pip install -qq --no-compile
# More arguments, e.g. `make test ARGS='-m slow'` or `make thesis ARGS=tanks`.
ARGS ?=

export PIP_DISABLE_PIP_VERSION_CHECK := 1
# The tests begin many processes: each takes the bytecode that the first one has written.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:
.PHONY: help install demo thesis league results test lowest newest browser lint types docs package constraints clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

install: $(VENV)/.full ## install the package with all extras and the development tools into .venv
	@echo "phsi_opt is installed in $(VENV)."

demo: $(VENV)/.core ## run the demonstration; needs, and installs where missing, the core alone
	@$(PY) -m problems.examples.demo

thesis: $(VENV)/.full ## run every experiment of the thesis (about an hour; ARGS=--quick: minutes, writes nothing)
	@$(PY) -m problems.thesis.run $(ARGS)

league: $(VENV)/.full ## public data sets under the protocol of those who published them (ARGS="--data=FOLDER emps": one of them)
	@$(PY) -m problems.league.run $(ARGS)

results: $(VENV)/.full ## list the pages in results/ that are older than the code (ARGS="--run --hours=8": make them again)
	@$(PY) -m problems.results $(ARGS)

# The tests of one file share fits, so they stay together; one thread each, since every processor has tests of its own.
test: $(VENV)/.full browser ## run the tests on all processors, but for slow ones (ARGS="-m slow": those)
	@OMP_NUM_THREADS=1 $(PY) -m pytest -n auto --dist loadfile --no-loadscope-reorder $(ARGS)

lowest: $(LOWEST) ## run the tests that depend most on other packages with the lowest versions that pyproject.toml allows
	@$(call tested_elsewhere,$(PYTHON),lowest,-c $(LOWEST))

newest: ## run them with the newest versions, on Python 3.13 where there is one (PYTHON_NEWEST=/path/to/python)
	@if $(PYTHON_NEWEST) -V > /dev/null 2>&1; then $(call tested_elsewhere,$(PYTHON_NEWEST),newest,); \
	else echo "There is no $(PYTHON_NEWEST) on this machine: nothing was tested with it."; fi

# In an environment of its own, where warnings of other versions are no errors: arguments are the interpreter, a folder in .venv, and more arguments of pip.
define tested_elsewhere
set -e; echo "Installing phsi_opt into $(VENV)/$(2)."; $(1) -m venv $(VENV)/$(2); \
$(VENV)/$(2)/bin/python $(PIP_INSTALL) --upgrade pip 'setuptools>=77'; \
$(VENV)/$(2)/bin/python $(PIP_INSTALL) $(3) --no-build-isolation -e '.[app,distributed,loggers]' pytest hypothesis; \
OMP_NUM_THREADS=1 $(VENV)/$(2)/bin/python -m pytest -o filterwarnings=default $(OTHERS) $(ARGS)
endef

$(LOWEST): pyproject.toml .ci/lowest.py
	@$(PY) .ci/lowest.py > $@

browser: ## install Chromium for the tests of the page, where there is none and apt may be used
	@if command -v chromium > /dev/null || command -v chromium-browser > /dev/null || \
			command -v google-chrome > /dev/null; then :; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get > /dev/null; then \
		echo "Installing Chromium, which the tests of the page drive."; \
		{ apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium > /dev/null; } || \
			echo "Chromium could not be installed: the tests of the page are skipped (with CI=true they fail)."; \
	else \
		echo "There is no Chromium, and no apt to install it with: the tests of the page are skipped" \
			"(with CI=true they fail). Install chromium or google-chrome."; \
	fi

lint: $(VENV)/.full ## check style and formatting
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .

types: $(VENV)/.full ## check types
	@$(PY) -m mypy

docs: $(VENV)/.full ## write the site into docs/_build/html: tutorial, how-tos, reference; warnings are errors
	@$(PY) -m sphinx -q -W --keep-going -n -b html -d docs/_build/doctrees docs docs/_build/html
	@echo "The site is in docs/_build/html/index.html."

# The wheel is made from the sdist, so that a file that the sdist lacks is missed here and not by a user.
package: $(VENV)/.full ## build sdist and wheel; the wheel runs the demonstration in an environment of its own
	@rm -rf build dist && mkdir -p dist && tmp=$$(mktemp -d) && trap 'rm -rf "$$tmp"' EXIT && set -e; \
	$(PY) -c 'from setuptools.build_meta import build_sdist; build_sdist("dist")' > "$$tmp/log" 2>&1 || \
		{ cat "$$tmp/log"; exit 1; }; \
	$(PY) -m pip wheel -qq --no-deps --no-build-isolation -w dist dist/*.tar.gz; \
	$(PYTHON) -m venv "$$tmp/venv"; \
	"$$tmp/venv/bin/python" $(PIP_INSTALL) -c $(CONSTRAINTS) dist/*.whl; \
	"$$tmp/venv/bin/python" -m pip check; \
	mkdir "$$tmp/empty" && cd "$$tmp/empty"; \
	env -u PYTHONPATH OMP_NUM_THREADS=1 "$$tmp/venv/bin/phsi-opt" demo > "$$tmp/log" 2>&1 || { cat "$$tmp/log"; exit 1; }; \
	tail -n 1 "$$tmp/log"; test -s phsi_opt_demo/report.html; \
	size=$$(du -sm "$$tmp"/venv/lib/python3*/site-packages | cut -f 1); \
	echo "The core takes $$size MB with the bytecode of what was used; sdist and wheel are in dist/."

constraints: ## write .ci/constraints.txt anew, with the newest versions that pyproject.toml allows
	@tmp=$$(mktemp -d) && trap 'rm -rf "$$tmp"' EXIT && set -e; \
	echo "Resolving all dependencies in a fresh environment; this may take some minutes."; \
	$(PYTHON) -m venv "$$tmp/venv"; \
	"$$tmp/venv/bin/python" $(PIP_INSTALL) --upgrade pip setuptools; \
	"$$tmp/venv/bin/python" $(PIP_INSTALL) --no-build-isolation -e '.[$(EXTRAS)]'; \
	"$$tmp/venv/bin/python" -m pip freeze --all --exclude-editable > "$$tmp/frozen"; \
	{ echo "# The exact version of every distribution in .venv: core, all extras and development tools."; \
	  echo "# Written by 'make constraints' (pip freeze in a fresh environment, local version labels cut off)."; \
	  sed -n 's/^\([A-Za-z0-9._-]*==[^+ ]*\).*/\1/p' "$$tmp/frozen"; } > "$$tmp/constraints.txt"; \
	cp "$$tmp/constraints.txt" $(CONSTRAINTS)

clean: ## remove caches and build products; .venv stays
	rm -rf build dist docs/_build docs/rooms docs/measured *.egg-info .pytest_cache .hypothesis .mypy_cache .ruff_cache
	find . -path ./$(VENV) -prune -o -type d -name __pycache__ -exec rm -rf {} +

# The stamps say what .venv holds. The full installation contains the core, so it renews both stamps, and
# `make demo` after `make test` installs nothing.

$(VENV)/.created:
	@command -v $(PYTHON) > /dev/null || \
		{ echo "$(PYTHON) was not found: install Python 3.11 or newer, or name it: make PYTHON=/path/to/python"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "phsi_opt needs Python 3.11 or newer, but $(PYTHON) is $$($(PYTHON) -V 2>&1): make PYTHON=/path/to/python"; exit 1; }
	@$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.core: pyproject.toml $(CONSTRAINTS) | $(VENV)/.created
	@echo "Installing the core of phsi_opt into $(VENV); this may take some minutes."
	@$(PY) $(PIP_INSTALL) -c $(CONSTRAINTS) pip setuptools
	@$(PY) $(PIP_INSTALL) -c $(CONSTRAINTS) --no-build-isolation -e .
	@touch $@

$(VENV)/.full: pyproject.toml $(CONSTRAINTS) | $(VENV)/.created
	@echo "Installing phsi_opt with all extras and development tools into $(VENV); this may take some minutes."
	@$(PY) $(PIP_INSTALL) -c $(CONSTRAINTS) pip setuptools
	@$(PY) $(PIP_INSTALL) -c $(CONSTRAINTS) --no-build-isolation -e '.[$(EXTRAS)]'
	@touch $(VENV)/.core $@
