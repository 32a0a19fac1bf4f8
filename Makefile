# The commands of the house. A machine needs Python 3.11 to 3.14 (with venv) and make, nothing else.
#
#   make demo      simulate a small suburb, reconstruct it, show what was found
#   make test      style, types, import directions, tests: everything but the slow tests
#   make slow      the slow tests: minutes, real processes, real data
#   make everything  both at once, as CI does
#   make wheel     a wheel for this platform, with the web page and compiled kernels
#   make kernels   list anew which kernels are compiled ahead (after a kernel was added or is called in a new way)
#   make site      the documentation as web pages, in build/docs/site: open index.html
#   make viewer    build the web page (types, unit tests, bundle); brings its own Node
#   make serve     the service on this machine, web page and all
#   make ruler     every suite and real tile, reconstructed and measured: all tables of docs/results/ (an hour)
#   make lock      resolve the dependencies anew (the locks name versions and hashes, no hosts)
#   make docs      write docs/reference/ from the code
#   make format    format the sources
#   make clean     remove what these commands made, the environment included

PYTHON ?= python3
OUT ?= demo
RULER ?= ruler
DATA ?= ../shared/data
VENV := .venv
BIN := $(VENV)/bin
UV := $(BIN)/uv --no-progress
COMPILE := $(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	--no-emit-find-links --custom-compile-command "make lock" pyproject.toml --extra otel --extra postgres --extra s3

KERNEL_SOURCES := $(shell grep -rl --include='*.py' kernel pipeline | LC_ALL=C sort)
KERNEL_LIST := pipeline/compiler/kernels.json

.DEFAULT_GOAL := help
.PHONY: help demo test check unit slow everything all-tests viewer site wheel kernels serve ruler lock docs format clean
.DELETE_ON_ERROR:

help:
	@sed -n 's/^#   //p' Makefile

# --- the environment -------------------------------------------------------------------------------------------------

# pip installs uv and the build backend by hash; uv then installs the rest by hash, in parallel.
$(VENV)/.build-stamp: requirements-build.lock
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if (3, 11) <= v < (3, 15) else \
		f"gablework needs Python 3.11 to 3.14, this is {v.major}.{v.minor}: make PYTHON=python3.12 ...")'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "Python's venv module is missing or incomplete: install it (Debian: python3-venv)." >&2; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-build.lock
	@touch $@

# The project itself, editable, built by the backend of the lock (no isolated build: nothing unpinned is fetched).
INSTALL_SELF = $(UV) pip install --quiet --python $(BIN)/python --no-deps --no-build-isolation --editable .

# What `make demo` needs. The locks agree, so this adds to an environment that has the test tools and removes nothing.
$(VENV)/.run-stamp: requirements.lock $(VENV)/.build-stamp pyproject.toml
	$(UV) pip install --quiet --python $(BIN)/python --require-hashes -r requirements.lock
	$(INSTALL_SELF)
	@touch $@

# What `make test` needs: exactly the locks.
$(VENV)/.test-stamp: requirements-test.lock $(VENV)/.build-stamp pyproject.toml
	$(UV) pip sync --quiet --python $(BIN)/python --require-hashes requirements-build.lock requirements-test.lock
	$(INSTALL_SELF)
	@touch $@ $(VENV)/.run-stamp

# Kernels, compiled on all cores. Each is kept under a hash of its code and of what it calls, so after an edit only what
# depends on it is compiled anew. The demo needs a part of them, the tests all.
$(VENV)/.warm-demo-stamp: requirements.lock $(KERNEL_SOURCES) $(KERNEL_LIST) | $(VENV)/.run-stamp
	@$(BIN)/gablework warm-up reconstruct simulate evaluate
	@touch $@

$(VENV)/.warm-stamp: requirements.lock $(KERNEL_SOURCES) $(KERNEL_LIST) | $(VENV)/.run-stamp
	@$(BIN)/gablework warm-up all
	@touch $@

lock: $(VENV)/.build-stamp
	$(COMPILE) --extra solar --group test -o requirements-test.lock
	$(COMPILE) -c requirements-test.lock -o requirements.lock
	$(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--no-emit-find-links --custom-compile-command "make lock" --group build \
		-c requirements-test.lock -o requirements-build.lock
	$(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--no-emit-find-links --custom-compile-command "make lock" --group viewer \
		-c requirements-test.lock -o requirements-viewer.lock
	$(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
		--no-emit-find-links --custom-compile-command "make lock" --group site \
		-c requirements-test.lock -o requirements-site.lock

# The web page, by the Node that its lock names. The environment of the tests may or may not hold it.
VIEWER_SOURCES := $(shell find service/viewer -type f -not -path '*/node_modules/*' -not -path '*/dist/*' 2>/dev/null)
service/viewer/dist/index.html: $(VIEWER_SOURCES) hatch_build.py requirements-viewer.lock $(VENV)/.build-stamp
	$(UV) pip install --quiet --python $(BIN)/python --require-hashes -r requirements-viewer.lock
	$(BIN)/python hatch_build.py
	@touch $@

# The documentation as web pages; a broken link ends it. A sync of the environment removes what it needs, hence the stamp.
$(VENV)/.site-stamp: requirements-site.lock $(VENV)/.build-stamp $(wildcard $(VENV)/.test-stamp)
	$(UV) pip install --quiet --python $(BIN)/python --require-hashes -r requirements-site.lock
	@touch $@

build/docs/site/index.html: $(VENV)/.site-stamp README.md CONTRIBUTING.md THIRD_PARTY_NOTICES.md $(shell find docs -type f)
	$(BIN)/python docs/site.py
	@touch $@

# --- the two commands ------------------------------------------------------------------------------------------------

demo: $(VENV)/.warm-demo-stamp
	@$(BIN)/gablework demo --out $(OUT) --overwrite

# Both at once: mypy has one thread, and a test that waits leaves the other processor idle. Their environment is made first.
test: $(VENV)/.test-stamp $(VENV)/.warm-stamp
	@$(MAKE) --no-print-directory --jobs 2 check unit

check: $(VENV)/.test-stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

# More processes than processors, as tests wait for processes, sockets and files; the slow ones wait most of their time.
# A file stays in one process, the longest come first, and all of the browser share one (tests/conftest.py).
PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest --dist loadfile --no-loadscope-reorder --durations=15

# A third of the examples of hypothesis; CI draws all.
unit: $(VENV)/.test-stamp $(VENV)/.warm-stamp
	HYPOTHESIS_PROFILE=$${HYPOTHESIS_PROFILE:-quick} $(PYTEST) --numprocesses 3 -m "not slow"

slow: $(VENV)/.test-stamp $(VENV)/.warm-stamp viewer
	$(PYTEST) --numprocesses 4 -m slow

# What CI runs: style, types and imports beside all else, and all tests at once, so that quick ones run where slow ones
# wait. Types take a processor for minutes: they begin while the page and the site are built, which leave one idle.
everything: $(VENV)/.test-stamp
	@$(MAKE) --no-print-directory --jobs 2 check all-tests

all-tests: $(VENV)/.test-stamp $(VENV)/.warm-stamp viewer site
	$(PYTEST) --numprocesses 4 -m "slow or not slow"

viewer: service/viewer/dist/index.html

site: build/docs/site/index.html

# A wheel for this platform and Python, with all kernels compiled: the first model compiles nothing. What was compiled for
# it is removed however this ends, since a checkout that holds it would use it.
wheel: $(VENV)/.run-stamp viewer
	@rm -rf pipeline/compiled
	@trap 'rm -rf pipeline/compiled' EXIT; trap 'exit 1' HUP INT TERM; \
		$(BIN)/gablework warm-up all --into pipeline/compiled && \
		$(BIN)/python -m hatchling build --target wheel --directory dist

# What is compiled ahead: recorded from runs, some minutes.
kernels: $(VENV)/.run-stamp
	$(BIN)/python -m benchmarks.kernel_list

serve: $(VENV)/.run-stamp viewer
	@$(BIN)/gablework serve

ruler: $(VENV)/.warm-stamp
	@mkdir -p $(RULER)
	$(BIN)/python -m benchmarks.ruler --out $(RULER) --data $(DATA)
	$(BIN)/python -m benchmarks.hofmann_tables --out $(RULER)

docs: $(VENV)/.run-stamp
	$(BIN)/python docs/generate.py
	$(BIN)/python docs/notices.py

format: $(VENV)/.test-stamp
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) pipeline/compiled .cache .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis demo runs build
	find pipeline service tests docs -name __pycache__ -type d -prune -exec rm -rf {} +
