# Every target sets up .venv first. An interpreter that already has the packages can be used instead: make train PYTHON=python3
BASE ?= python3
PYTHON ?= .venv/bin/python
CORES := $(shell nproc 2>/dev/null || echo 1)

# The virtual environment is made only when it is the interpreter in use.
SETUP := $(if $(filter .venv/bin/python,$(PYTHON)),.venv/stamp)

KERNELS := $(shell find megastep agents tests -name "*.h" -o -name "*.cu" -o -name "*.cpp")

.PHONY: train test test-all lint setup clean

train: $(SETUP)            ## train Explorer in homes, evaluate it in unseen ones, film it
	$(PYTHON) train.py experiment=quickstart

test: $(SETUP)             ## the tests, without those marked slow
	$(PYTHON) -m pytest -q -n $(CORES)

test-all: $(SETUP)         ## every test
	$(PYTHON) -m pytest -q -n $(CORES) -m "slow or not slow"

lint: $(SETUP)
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -c "import clang_format; clang_format.clang_format()" --dry-run --Werror $(KERNELS)

setup: $(SETUP)

.venv/stamp: pyproject.toml constraints.txt
	@$(BASE) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { echo "megastep needs Python 3.10 or newer; choose one with: make BASE=python3.12"; exit 1; }
	@$(BASE) -c 'import ensurepip' 2>/dev/null || { echo "This Python cannot make virtual environments; on Debian: apt install python3-venv"; exit 1; }
	$(BASE) -m venv .venv
	.venv/bin/python -m pip install -c constraints.txt torch==2.13.0
	.venv/bin/python -m pip install -c constraints.txt -e '.[test]'
	touch .venv/stamp

clean:
	rm -rf .venv build *.egg-info .pytest_cache .ruff_cache
