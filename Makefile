# Every command runs in .venv, which is set up from the lock when needed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
LOCK := environment/requirements.lock
READY := $(VENV)/.ready
UV_LOCK := environment/uv.txt
UV := $(BIN)/uv --quiet
PIN = $(UV) pip compile $(if $(PACKAGE),--upgrade-package $(PACKAGE),--upgrade) --generate-hashes \
	--no-emit-index-url --custom-compile-command "make lock"

# The folder and the Python of the environment. The set-up writes them to $(READY) at its end. After an interruption,
# a move of the folder or a change of Python they differ, and the set-up is repeated. Python reads the path of this
# folder in the encoding of the locale.
IDENTITY := LC_ALL=C.UTF-8 $(BIN)/python -I -X utf8 -c 'import sys; print(sys.prefix, *sys.version_info[:2])'
ifneq ($(shell $(IDENTITY) 2>/dev/null | cmp -s - $(READY) && echo same),same)
.PHONY: $(BIN)/uv
endif

# Matplotlib, IPython, Jupyter and uv warn or fail if they cannot write to the home folder.
ifneq ($(shell test -d "$$HOME" && test -w "$$HOME" && echo writable),writable)
$(shell mkdir -p _build/home)
export HOME := $(CURDIR)/_build/home
endif

# What runs depends on the lock and on this folder, not on variables of the caller.
unexport $(filter PYTHON% MPLBACKEND MATPLOTLIBRC,$(.VARIABLES))
export PYTHONUTF8 = 1

# Python and setuptools read and write the path of this folder in the encoding of the locale, which may not be installed.
ifneq ($(shell locale charmap 2>/dev/null),UTF-8)
export LC_ALL := C.UTF-8
endif

# One thread for each process: the same numbers on every machine, and no contention between notebooks.
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1
export MKL_NUM_THREADS = 1
export VECLIB_MAXIMUM_THREADS = 1

# Linked files would be shared with the cache and with every other environment: damage to one would reach all.
export UV_LINK_MODE = copy

# Neither make nor the shell expands these: only the command rerun reads them, from an environment variable.
export RERUN := $(value FIGURE) $(value ARGS)
unexport FIGURE ARGS

QUICK := --numprocesses auto --dist loadfile --benchmark-disable -m "not slow"

# A command in an environment of its own: the built package with an extra, in the versions of a file, in a folder
# without the source. uv looks for Pythons on the path; pyenv has them elsewhere.
alone = cd _build/alone && ../../$(UV) tool run --isolated --constraints ../../$(2) --with "$$(echo ../dist/*.whl)[$(1)]"
CORE := --doctest-modules --pyargs zwfs $(patsubst %,tests/test_%.py,detector masks metrics modes pupil sensor)
PYTHONS ?= 3.11 3.12 3.13 lowest
pythons: export PATH := $(PATH):$(subst $() ,:,$(wildcard $(HOME)/.pyenv/versions/3.1[1-9]*/bin))
define IMPORT_STUDIES
import pkgutil, sys
sys.path.append("../../notebooks")
import studies
for module in pkgutil.walk_packages(studies.__path__, "studies."):
    __import__(module.name)
endef
release-check: export IMPORT_STUDIES := $(IMPORT_STUDIES)

.DELETE_ON_ERROR:
.PHONY: help book lab test test-fast test-slow coverage fuzz figures rerun lint bench dist release-check pythons lock clean

help: ## list these commands
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 21

book: $(READY) ## run the notebooks that changed and build the book in _build/html
	@$(BIN)/python -m book._tools book

lab: $(READY) ## open the notebooks in JupyterLab
	$(BIN)/jupyter lab notebooks

test: $(READY) ## test the package and the tools, and compare each notebook with a fresh run
	$(BIN)/python -m pytest $(QUICK) tests
	$(BIN)/python -m pytest --numprocesses auto --doctest-modules zwfs
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile --nbval --nbval-current-env \
		--nbval-cell-timeout 2400 notebooks

test-fast: $(READY) ## test the package only, in about 3 minutes
	$(BIN)/python -m pytest $(QUICK) $$(grep -LE "ROOT|book|notebooks|studies" tests/test_*.py)

test-slow: $(READY) ## the rest of the tests: real builds of the book, kills, clusters, long fits, full books in a browser
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile --benchmark-disable -m "slow and not fuzz" tests

coverage: $(READY) ## the quick tests again, twice as slow, with the lines that they do not reach
	$(BIN)/python -m pytest $(QUICK) --cov --cov-report term:skip-covered tests

fuzz: $(READY) ## try 1000 new camera files and options for each property, and each odd parameter of a notebook alone
	$(BIN)/python -m pytest --numprocesses auto --hypothesis-profile fuzz tests/test_fuzzing.py tests/test_truth.py

figures: $(READY) ## replace the committed notebooks by freshly run ones
	@$(BIN)/python -m book._tools figures

rerun: $(READY) ## run one notebook with other parameters: make rerun FIGURE=3 ARGS="-p rms_max=2.0"
	@$(BIN)/python -m book._tools rerun "--line=$$RERUN"

lint: $(READY) ## check style, formatting and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(READY) ## time the reconstructors, next to other packages, for the performance page
	@mkdir -p _build
	$(BIN)/python -m pytest tests/benchmarks --benchmark-only --benchmark-json=_build/measured.json
	$(BIN)/python -m tests.benchmarks.report _build/measured.json

dist: $(READY)
	@rm -rf _build/dist _build/alone
	@$(UV) build --no-build-isolation --python $(BIN)/python --out-dir _build/dist
	@mkdir -p _build/alone
	@cp -R tests pyproject.toml _build/alone

release-check: dist ## build the package in _build/dist, and test it in an empty environment
	@$(call alone,test,$(LOCK)) pytest $(QUICK) $(CORE)
	@$(call alone,notebooks,$(LOCK)) python -c "$$IMPORT_STUDIES"

pythons: dist ## run examples and core tests on every supported Python, and with the oldest dependencies
	@for python in $(PYTHONS); do \
		version=$$(echo $$python | sed s/lowest/3.11/); \
		$(UV) python find $$version >/dev/null 2>&1 || $(UV) python install $$version 2>/dev/null || \
			{ echo "Python $$python: not tested, because it is not installed and uv cannot fetch it here"; continue; }; \
		pins=$(LOCK); \
		if test $$python = lowest; then \
			pins=_build/alone/lowest.txt; \
			$(UV) pip compile --resolution lowest-direct --extra test --python-version 3.11 --no-header \
				--output-file $$pins pyproject.toml >/dev/null || exit 1; \
		fi; \
		($(call alone,test,$$pins) --python $$version pytest $(QUICK) $(CORE)) || exit 1; \
		echo "Python $$python: passed"; \
	done

lock: $(BIN)/uv ## pin the newest allowed version of every dependency, or of one: make lock PACKAGE=numpy
	$(PIN) pyproject.toml --extra book --extra cluster --extra lab --extra test \
		--universal --python-version 3.11 --fork-strategy fewest --output-file $(LOCK)
	echo uv | $(PIN) - --no-annotate --output-file $(UV_LOCK)

# Other files in _build belong to the user, above all the results of make rerun.
clean: ## remove the results of these commands, except those of make rerun
	rm -rf $(addprefix _build/,alone home html html.json jupyter_execute measured.json notebooks performance dist building-* running-* rerunning-*)
	rm -rf build $(VENV) *.egg-info .benchmarks .coverage* .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name _build -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +
	@if [ -d _build ] && ! rmdir _build 2>/dev/null; then echo "kept: $$(echo _build/*)"; fi

$(BIN)/uv:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "zwfs needs Python 3.11 or newer (tested: $(filter 3.%,$(PYTHONS)));" \
		"$(PYTHON) is $$($(PYTHON) --version 2>&1)." \
		"Choose another: make PYTHON=python3.12" >&2; exit 1; }
	@echo "setting up $(VENV)"
	@$(PYTHON) -m venv --clear $(VENV)
	@$(BIN)/python -m pip --quiet --disable-pip-version-check install --require-hashes --requirement $(UV_LOCK)

# The compatible mode puts this folder on the path of Python. The default mode fails in a folder with a folder zwfs.
# studies.pth adds that of the studies, so that notebooks find them from any working directory.
$(READY): $(LOCK) pyproject.toml $(BIN)/uv
	@rm -f $@
	@$(UV) pip sync --python $(BIN)/python --compile-bytecode --require-hashes $(LOCK)
	@$(UV) pip install --python $(BIN)/python --no-deps --no-build-isolation \
		--config-settings editable_mode=compat --editable .
	@echo "$(CURDIR)/notebooks" > "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/studies.pth"
	@$(BIN)/python -I environment/check.py
	@$(IDENTITY) > $@
