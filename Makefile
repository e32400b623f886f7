# Everything needs only make and Python >= 3.11: the first target you call builds a virtual environment in .venv.
#
#   make demo     one graph that estimates and plans drives a robot through a building; writes out/demo/scene.html
#   make test     run the tests; of large tables and long scenes a draw, another one for each commit
#   make test-all run the tests with all cases
#   make test-lowest    the same with the lowest versions of all packages that pyproject.toml allows, in .venv-lowest
#   make processes    graphs and solutions in other processes, however these begin, with joblib and dask (a minute)
#   make fuzz     mutated files for every reader, a minute each
#   make lint     check style (ruff) and types (mypy; what users write with pyright, too)
#   make performance  time what the library does beside the last accepted commit; fails for a loss of 15 % (a minute)
#   make bench    measure everything again and rewrite the tables in docs/ (long)
#   make sample   repeat two figures of a page, drawn by the date: counts, not times
#   make results PAGE=control    measure one page of docs/results again; without PAGE, list them
#   make release-build    build sdist and wheel twice, compare, try the wheel with every Python here (some minutes each)
#   make release-check    the same, and fail for kernels that are out of date
#   make kernels  compile everything anew into unifg/codegen/kernels.zip, which spares a first use most of it (minutes)
#   make mutants  change decisions one at a time and see whether a test notices (hours; FILES='scenarios/ground/drive_past.py')
#   make peers    build .venv-peers with acados, drake, crocoddyl and jaxls, and measure docs/results/peers.md (ten minutes)
#   make first-use  time README's first example in a new environment of every Python that is found (minutes)
#   make examples run all scripts of examples/ and draw the pictures of docs/guide/examples.md again
#   make offsets  solve the same problems with their worlds moved by up to 5000 km (minutes)
#   make docs     build the site with the reference of all public names into out/site, every link checked
#   make notebooks  run the notebooks of docs/notebooks as a reader does, with a kernel, into out/notebooks
#   make fences   run all code shown in README.md and docs/; FENCES=--half draws pages of shell commands by commit
#   make clean    remove everything made here
#
# Choose the interpreter with PYTHON=/path/to/python3, the number of test processes with WORKERS=4, and what pytest
# gets besides with PYTEST='-k planner'; what release-build tries with RELEASE='--python 3.12 --newest'.

# The first of these that is new enough; python3 when none is, so that the message below names its version.
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo $$p; exit; }; done; echo python3)
WORKERS ?= 2

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
# Matrices here are small: more threads per process only make the processes wait for each other.
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1

.PHONY: first-use peers docs kernels performance notebooks help demo test test-all fuzz test-lowest processes lint style types mypy pyright bench results sample release-build release-kernels release-check mutants fences clean offsets examples
.DELETE_ON_ERROR:

# Tests start some fifty processes; without what Python has compiled, each would compile all sources anew.
unexport PYTHONDONTWRITEBYTECODE

help:
	@sed -n '2,/^$$/s/^# \{0,1\}//p' Makefile

demo: $(VENV)/installed
	$(BIN)/unifg run navigation --coupling joint --obstacles 3 --seed 0 --out out/demo

test: $(VENV)/ready
	$(ONE_THREAD) $(BIN)/unifg warmup
	$(ONE_THREAD) $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(PYTEST)

test-all: $(VENV)/ready
	$(MAKE) test PYTEST="--all $(PYTEST)"

# What is old calls what is new in ways that have since been deprecated.
test-lowest: $(VENV)-lowest/ready
	$(ONE_THREAD) $(VENV)-lowest/bin/unifg warmup
	$(ONE_THREAD) $(VENV)-lowest/bin/python -m pytest -n $(WORKERS) --dist loadfile -W ignore::DeprecationWarning $(PYTEST)

fuzz: $(VENV)/ready
	$(BIN)/python -m benchmarks.fuzz

processes: $(VENV)/ready
	$(PIP) install joblib dask
	UNIFG_EVERY_START=1 $(ONE_THREAD) $(BIN)/python -m pytest tests/test_processes.py

lint: style types

style: $(VENV)/ready-dev
	$(BIN)/ruff check --output-format concise .

types: mypy pyright

mypy: $(VENV)/ready-dev
	$(BIN)/mypy

pyright: $(VENV)/ready-dev
	$(BIN)/basedpyright

bench: $(VENV)/ready-bench
	$(BIN)/python -m benchmarks all

results: $(VENV)/ready-bench
	@test -n "$(PAGE)" || { $(BIN)/python -m benchmarks; echo "Choose: make results PAGE=name"; exit 2; }
	$(BIN)/python -m benchmarks $(PAGE)

peers: $(VENV)-peers/ready
	$(VENV)-peers/bin/python -m benchmarks peers

first-use: $(VENV)/ready
	$(BIN)/python -m benchmarks first-use --fresh

sample: $(VENV)/ready
	@$(ONE_THREAD) $(BIN)/python -m benchmarks.collection

release-build: $(VENV)/ready
	$(BIN)/python docs/check_release.py $(RELEASE)

release-kernels: $(VENV)/ready
	@$(BIN)/unifg warmup --check

release-check: release-build release-kernels

kernels: $(VENV)/ready
	NUMBA_CPU_NAME=generic UNIFG_CACHE_DIR=$(CURDIR)/out/kernels $(ONE_THREAD) $(BIN)/unifg warmup --ship

performance: $(VENV)/ready
	$(ONE_THREAD) $(BIN)/python -m tools.performance

mutants: $(VENV)/ready
	$(ONE_THREAD) $(BIN)/python -m tools.mutants $(FILES)

offsets: $(VENV)/ready
	$(ONE_THREAD) $(BIN)/python -m benchmarks.offsets

examples: $(VENV)/ready
	$(BIN)/python docs/images/draw_examples.py

docs: $(VENV)/ready-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo out/site/readme.html

notebooks: $(VENV)/ready-notebooks
	$(ONE_THREAD) $(BIN)/python docs/run_notebooks.py

fences: $(VENV)/ready
	$(ONE_THREAD) $(BIN)/python -m pytest -n $(WORKERS) -q --all tests/test_docs.py -k python_blocks
	$(BIN)/python docs/check_shell_fences.py $(FENCES)

clean:
	rm -rf $(VENV) $(VENV)-lowest $(VENV)-peers out build dist unifg.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage htmlcov
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Each file marks one finished installation; a change of pyproject.toml repeats it.
$(VENV)/installed: pyproject.toml
	@command -v $(PYTHON) >/dev/null || { \
		echo "unifg needs Python 3.11 or newer and found no '$(PYTHON)'. Install one, or name it: make PYTHON=/path/to/python3" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; v = sys.version.split()[0]; sys.exit(None if sys.version_info >= (3, 11) else \
		"unifg needs Python 3.11 or newer, and $(PYTHON) is %s. Name a newer one: make PYTHON=/path/to/python3" % v)'
	@echo "Building $(VENV) and installing unifg into it (once, half a minute)"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "$(PYTHON) cannot build virtual environments; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
	@$(PIP) install --no-compile --editable ".[scenarios]"
	@touch $@

$(VENV)/ready: $(VENV)/installed
	@echo "Installing what tests need into $(VENV)"
	@$(PIP) install --editable ".[scenarios,test]"
	@touch $@

$(VENV)-lowest/ready: pyproject.toml tests/lowest.py
	@echo "Building $(VENV)-lowest with the lowest versions of all packages (once, some minutes)"
	@$(PYTHON) -m venv $(VENV)-lowest
	@$(PYTHON) tests/lowest.py > $(VENV)-lowest/lowest.txt
	@$(VENV)-lowest/bin/python -m pip --disable-pip-version-check --quiet --log $(VENV)-lowest/pip.log install \
		--constraint $(VENV)-lowest/lowest.txt --editable ".[scenarios,test]" || { \
		sed -n 's/^[^ ]* *//; /conflict is caused by/,/^To fix/p' $(VENV)-lowest/pip.log >&2; exit 1; }
	@touch $@

$(VENV)/ready-dev: $(VENV)/ready
	@echo "Installing ruff, mypy and pyright into $(VENV)"
	@$(PIP) install --editable ".[scenarios,dev]"
	@touch $@

$(VENV)/ready-notebooks: $(VENV)/ready
	@echo "Installing what runs notebooks into $(VENV)"
	@$(PIP) install --editable ".[scenarios,notebooks]"
	@touch $@

$(VENV)/ready-docs: $(VENV)/ready
	@echo "Installing the tools of the site into $(VENV)"
	@$(PIP) install --editable ".[scenarios,docs]"
	@touch $@

$(VENV)/ready-bench: $(VENV)/ready
	@echo "Installing the packages we compare with into $(VENV)"
	@$(PIP) install --editable ".[scenarios,test,bench]"
	@touch $@

# An environment of its own: none of the packages belongs to what is tested, and some of them are large.
$(VENV)-peers/ready: pyproject.toml
	@echo "Building $(VENV)-peers with the solvers we compare with (once, a minute or two; needs gcc)"
	@$(PYTHON) -m venv $(VENV)-peers
	@$(VENV)-peers/bin/python -m pip --disable-pip-version-check --quiet install --editable ".[scenarios,test,peers]"
	@touch $@
