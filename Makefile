# `make demo` and `make test` do all their own set-up on a machine with Python 3.11+ and make.
PYTHON ?= python3
DEMO_VENV := .venv-demo
VENV := .venv
SYSTEM_LIBRARIES := libegl1 libgl1 libx11-6 libudev1 libusb-1.0-0 libidn2-0 libgomp1 xvfb chromium chromium-driver firefox-esr
RUN := $(VENV)/bin
SIDE_BY_SIDE := -q -n auto --dist worksteal
COVERAGE := 90 # percent; below it, `make coverage` fails

# Tests start hundreds of processes: each would compile the modules of all packages again, for a second.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow test-lowest test-newest test-wheel coverage faults lint types unit benchmark figures benchmark-ssc docs notebooks page clean

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 16

demo: $(DEMO_VENV)/ready ## simulate a town, make its ground truth, check it, draw it
	$(DEMO_VENV)/bin/carlasc demo demo

# mypy works on one core: side by side with the tests it costs half its time. A test builds the documentation.
test: $(VENV)/ready .system-libraries lint ## lint, types and the quick tests, which build the documentation
	$(MAKE) --jobs 2 types unit

test-slow: $(VENV)/ready .system-libraries ## the slow tests: notebooks, browsers, pages of commands, training, benchmarks once
	$(RUN)/pytest $(SIDE_BY_SIDE) -m slow

# Each with a cache of its own for compiled code: versions of numba do not read each other's.
test-lowest: .venv-lowest/ready ## the quick tests with the lowest versions that pyproject.toml allows (PYTHON=python3.11)
	NUMBA_CACHE_DIR=$(CURDIR)/.venv-lowest/numba .venv-lowest/bin/pytest $(SIDE_BY_SIDE)

test-newest: .venv-newest/ready ## the quick tests with the newest versions of everything (PYTHON=python3.13)
	NUMBA_CACHE_DIR=$(CURDIR)/.venv-newest/numba .venv-newest/bin/pytest $(SIDE_BY_SIDE)

test-wheel: .venv-wheel/ready ## the quick tests with the package installed as users do, not editable
	.venv-wheel/bin/pip install --quiet --no-deps --force-reinstall .
	NUMBA_CACHE_DIR=$(CURDIR)/.venv-wheel/numba .venv-wheel/bin/pytest $(SIDE_BY_SIDE)

coverage: $(VENV)/ready .system-libraries ## all tests, with the lines that they reach
	$(RUN)/pytest $(SIDE_BY_SIDE) -m '' --cov --cov-report=term --cov-report=xml --cov-fail-under=$(COVERAGE)

lint: $(VENV)/ready ## ruff
	$(RUN)/ruff check .
	$(RUN)/ruff format --check .

types: $(VENV)/ready ## mypy
	$(RUN)/mypy
	cd examples && MYPYPATH=.:mixture ../$(RUN)/mypy --cache-dir ../.mypy_cache --config-file ../pyproject.toml .
	cd docs/studies && MYPYPATH=.:../../converters:../../tests ../../$(RUN)/mypy --cache-dir ../../.mypy_cache --config-file ../../pyproject.toml .

unit: $(VENV)/ready ## the quick tests
	$(RUN)/pytest $(SIDE_BY_SIDE)

benchmark: $(VENV)/ready ## time the hot paths (docs/performance.md)
	$(RUN)/pytest tests/benchmarks --benchmark-enable --benchmark-only -p no:xdist -m slow

faults: $(VENV)/ready ## kill, damage and deceive every command, and publish the figures, half an hour (SIZE=long: hours; COUNT=N cases of each kind)
	@$(RUN)/python -c "import atheris" 2>/dev/null || $(RUN)/pip install --quiet --constraint constraints.txt "atheris>=3.0" \
		|| echo "atheris cannot be installed here: mutations that are guided by coverage are left out"
	PYTHONPATH=tests:tests/tools:examples $(RUN)/python -m faults --size $(or $(SIZE),quick) $(if $(COUNT),--count $(COUNT))

figures: $(VENV)/ready ## measure every figure of the documentation, on an idle machine, 20 minutes (SIZE=full: an hour or more; SIZE=tiny: try all, into build/; ONLY=GROUP)
	@mkdir -p build
	PYTHONPATH=tests:tests/tools $(RUN)/python -m measuring --size $(or $(SIZE),quick) $(if $(ONLY),--only $(ONLY)) $(if $(filter tiny,$(SIZE)),--out build/figures.json)

benchmark-ssc: $(VENV)/ready ## train networks on simulated drives and keep the results, 20 minutes (SIZE=medium: an hour, SIZE=long: a day, SIZE=full: on a GPU)
	$(RUN)/python examples/benchmark.py build/benchmark-ssc --size $(or $(SIZE),small)

notebooks: $(VENV)/ready ## run the notebooks and keep what they show in them
	$(RUN)/python examples/notebooks/run.py

page: ## build the bundle of the shareable page again from npm
	carlasc/viewing/page/assets/build.sh

docs: $(VENV)/ready ## the documentation, built strictly into site/
	NO_MKDOCS_2_WARNING=1 $(RUN)/mkdocs build --strict --quiet

clean: ## remove environments and what was built
	rm -rf $(VENV) $(DEMO_VENV) .venv-lowest .venv-newest .venv-wheel site demo build dist test-output .mypy_cache .ruff_cache .pytest_cache .hypothesis

# Makes a virtual environment in the folder $(1).
define virtual_environment
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "carlasc needs Python 3.11 or newer: make $(MAKECMDGOALS) PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -m venv $(1) || { echo "no virtual environment could be made: on Debian, apt install python3-venv"; exit 1; }
endef
TORCH := torch==2.13.0
EVERYTHING := all,torch,view,rerun,dev

$(DEMO_VENV)/ready: pyproject.toml constraints.txt
	$(call virtual_environment,$(DEMO_VENV))
	$(DEMO_VENV)/bin/pip install --quiet --no-compile --constraint constraints.txt --editable '.[demo]'
	@touch $@

# uv installs five times as fast as pip but does not read pip's settings, such as a mirror: where it fails, pip does the work.
$(VENV)/ready: pyproject.toml constraints.txt
	$(call virtual_environment,$(VENV))
	$(RUN)/pip install --quiet --no-compile uv '$(TORCH)'
	VIRTUAL_ENV=$(VENV) $(RUN)/uv pip install --quiet --constraint constraints.txt --editable '.[$(EVERYTHING)]' \
		|| $(RUN)/pip install --quiet --no-compile --constraint constraints.txt --editable '.[$(EVERYTHING)]'
	@touch $@

.venv-lowest/ready: pyproject.toml
	$(call virtual_environment,.venv-lowest)
	.venv-lowest/bin/pip install --quiet --no-compile uv '$(TORCH)'
	VIRTUAL_ENV=.venv-lowest .venv-lowest/bin/uv pip install --quiet --resolution lowest-direct --editable '.[$(EVERYTHING)]'
	@touch $@

# Without torch, which on Linux is gigabytes: its tests skip. `EXTRAS=all,torch,view,rerun,dev` has it too.
EXTRAS ?= all,view,rerun,dev
.venv-newest/ready: pyproject.toml
	$(call virtual_environment,.venv-newest)
	.venv-newest/bin/pip install --quiet --no-compile --editable '.[$(EXTRAS)]'
	@touch $@

.venv-wheel/ready: pyproject.toml constraints.txt
	$(call virtual_environment,.venv-wheel)
	.venv-wheel/bin/pip install --quiet --no-compile --constraint constraints.txt '.[$(EXTRAS)]'
	@touch $@

# Open3D's window and the browser tests need these; without them those tests say so and skip.
.PHONY: .system-libraries
.system-libraries:
	@if command -v dpkg-query >/dev/null && ! dpkg-query -W $(SYSTEM_LIBRARIES) >/dev/null 2>&1; then \
		if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
			apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends $(SYSTEM_LIBRARIES) >/dev/null; \
		else echo "some tests will skip: as root, apt-get install $(SYSTEM_LIBRARIES)"; fi; \
	fi
