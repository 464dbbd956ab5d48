# Every target creates .venv first. To use an interpreter that already has the packages instead:
#   make train PYTHON=python3
BASE ?= python3
PYTHON ?= .venv/bin/python
CORES := $(shell nproc 2>/dev/null || echo 1)
# Some tests wait, for a time limit or another process, so there is a worker more than there are cores.
WORKERS := $(shell expr $(CORES) + 1)
SEED ?= 1

# Neighbouring tests share a process, and what they prepare. Tests start many processes, which
# import faster from bytecode.
PYTEST = PYTHONDONTWRITEBYTECODE= $(PYTHON) -m pytest -q -n $(WORKERS) --dist worksteal

# Create the virtual environment only if it is the interpreter in use.
SETUP := $(if $(filter .venv/bin/python,$(PYTHON)),.venv/stamp)

# `find` does not follow links, so agents/ is not listed twice through megastep/agents.
KERNELS := $(shell find megastep agents tests -name "*.h" -o -name "*.cu" -o -name "*.cpp")

.PHONY: train test test-slow test-nightly test-gpu lint wasm docs pictures image wheel setup lock clean

train: $(SETUP)            ## train an Explorer agent, evaluate it in unseen homes and film it
	$(PYTHON) train.py experiment=quickstart

test: $(SETUP)             ## run the fast tests: 4 to 5 minutes on two cores
	$(PYTEST) -m "not slow and not nightly"

test-slow: WORKERS := $(shell expr $(CORES) + 2)
test-slow: $(SETUP)        ## run the thorough tests: 3 to 4 minutes
	$(PYTEST) -m slow

test-nightly: $(SETUP)     ## soak, CPU sanitizers, laws and 30 mutants: an hour; SEED=2 makes others
	$(PYTEST) -m nightly
	EXAMPLES=2000 $(PYTEST) tests/test_laws.py
	$(PYTHON) scripts/mutate.py --n 30 --seed $(SEED) --jobs $(CORES)

test-gpu: $(SETUP)         ## run the tests that need a GPU
	$(PYTHON) -m pytest -q -m cuda

lint: $(SETUP)             ## check style, formatting and types of Python, and the format of kernels
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(PYTHON) -m pyright --pythonpath $(PYTHON)
	$(PYTHON) -c "import clang_format; clang_format.clang_format()" --dry-run --Werror $(KERNELS)

pictures: $(SETUP)         ## draw the pictures of README and docs again, from packaged agents
	$(PYTHON) scripts/pictures.py

wasm: $(SETUP)             ## build the kernels of web pages again, megastep/web/megastep.wasm
	$(PYTHON) scripts/build_wasm.py

docs: $(SETUP)             ## build the site in docs/_build; warnings are errors
	test -f docs/play/minimal.mp4 || $(PYTHON) scripts/pictures.py gallery
	$(PYTHON) -m sphinx -W --keep-going -q docs docs/_build

image:                     ## build the container image with buildah, and try it
	$(BASE) scripts/check_image.py

wheel:                     ## build sdist and wheel into dist/, check them, train with the wheel alone
	rm -rf dist build
	$(BASE) -m venv build/tools
	build/tools/bin/python -m pip install -q build==1.6.1 twine==7.0.0
	build/tools/bin/python -m build
	build/tools/bin/python -m twine check --strict dist/*
	$(BASE) -m venv build/empty
	build/empty/bin/python -m pip install -q -c constraints.txt torch==2.13.0 dist/*.whl
	mkdir build/folder
	cd build/folder && env -u PYTHONPATH ../empty/bin/megastep train env=minimal geometry=box samples=1e5

setup: $(SETUP)            ## create .venv

# Python 3.10 to 3.13 get the versions in requirements/, checked against their hashes; other Pythons,
# and those for which that fails, the newest versions. PyTorch comes from wherever pip finds it. Some
# packages are built from source, without isolation: with the setuptools whose hash is checked.
# pip would compile 17,000 files, one after the other: what is used is compiled when it is imported.
INSTALL = .venv/bin/python -m pip install --no-compile
HASHED = $(INSTALL) --no-deps --require-hashes --no-build-isolation
TORCH = $(INSTALL) -c constraints.txt torch==2.13.0
# pip mostly waits for the package index, so two of them install different packages.
LOCKED = $(BASE) -c 'import sys; sys.exit(sys.version_info >= (3, 14))' \
	&& $(HASHED) -r requirements/build.txt \
	&& { $(HASHED) -q -r requirements/test.txt & \
		$(HASHED) -r requirements/packages.txt && $(TORCH); run=$$?; wait $$! && test $$run = 0; }

.venv/stamp: pyproject.toml constraints.txt $(wildcard requirements/*.txt)
	@$(BASE) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { echo "megastep needs Python 3.10 or newer. Choose one with: make BASE=python3.12"; exit 1; }
	@$(BASE) -c 'import ensurepip' 2>/dev/null || { echo "This Python cannot create virtual environments. On Debian: apt install python3-venv"; exit 1; }
	$(BASE) -m venv .venv
	{ $(LOCKED); } || { echo "The versions in requirements/ cannot be installed here; taking the newest that fit."; $(INSTALL) setuptools; }
	$(TORCH)
	$(INSTALL) -c constraints.txt --no-build-isolation -e '.[test]'
	PYTHONDONTWRITEBYTECODE= .venv/bin/python -c "import megastep.agents.cli.train, megastep.agents.cli.record"
	touch .venv/stamp

lock:                      ## resolve the versions in requirements/ anew; needs uv
	$(BASE) scripts/lock.py

clean:                     ## delete .venv, build folders and caches
	rm -rf .venv docs/_build docs/jupyter_execute docs/play build dist *.egg-info .pytest_cache .ruff_cache
