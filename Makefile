# `make demo` and `make test` do all their own set-up on a machine with Python 3.11+ and make.
PYTHON ?= python3
DEMO_VENV := .venv-demo
VENV := .venv
SYSTEM_LIBRARIES := libegl1 libgl1 libx11-6 libudev1 libusb-1.0-0 libidn2-0 libgomp1 xvfb chromium chromium-driver
RUN := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help demo test lint types unit benchmark benchmark-ssc docs page clean

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 16

demo: $(DEMO_VENV)/ready ## simulate a town, make its ground truth, check it, draw it
	$(DEMO_VENV)/bin/carlasc demo demo

test: $(VENV)/ready .system-libraries lint types docs unit ## everything: lint, types, documentation, tests

lint: $(VENV)/ready ## ruff
	$(RUN)/ruff check .
	$(RUN)/ruff format --check .

types: $(VENV)/ready ## mypy
	$(RUN)/mypy
	cd examples && MYPYPATH=. ../$(RUN)/mypy --config-file ../pyproject.toml .

unit: $(VENV)/ready ## the tests
	$(RUN)/pytest -n auto --dist worksteal -q

benchmark: $(VENV)/ready ## time the hot paths (docs/performance.md)
	$(RUN)/pytest tests/benchmarks --benchmark-enable --benchmark-only -p no:xdist

benchmark-ssc: $(VENV)/ready ## train the networks on a small simulated data set and print the tables (SIZE=full on a GPU)
	$(RUN)/python examples/benchmark.py build/benchmark-ssc --size $(or $(SIZE),small) --history

page: ## build the bundle of the shareable page again from npm
	carlasc/viewing/page/build.sh

docs: $(VENV)/ready ## the documentation, built strictly into site/
	NO_MKDOCS_2_WARNING=1 $(RUN)/mkdocs build --strict --quiet

clean: ## remove environments and what was built
	rm -rf $(VENV) $(DEMO_VENV) site demo build dist test-output .mypy_cache .ruff_cache .pytest_cache .hypothesis

$(DEMO_VENV)/ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "carlasc needs Python 3.11 or newer: set it with make demo PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -m venv $(DEMO_VENV) || { echo "no virtual environment could be made: on Debian, apt install python3-venv"; exit 1; }
	$(DEMO_VENV)/bin/pip install --quiet --constraint constraints.txt --editable '.[simulate,render]'
	@touch $@

$(VENV)/ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "carlasc needs Python 3.11 or newer: set it with make test PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { echo "no virtual environment could be made: on Debian, apt install python3-venv"; exit 1; }
	$(RUN)/pip install --quiet 'torch==2.13.0'
	$(RUN)/pip install --quiet --constraint constraints.txt --editable '.[all,dev]'
	@touch $@

# Open3D's window and the browser tests need these; without them those tests say so and skip.
.PHONY: .system-libraries
.system-libraries:
	@if command -v dpkg-query >/dev/null && ! dpkg-query -W $(SYSTEM_LIBRARIES) >/dev/null 2>&1; then \
		if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
			apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends $(SYSTEM_LIBRARIES) >/dev/null; \
		else echo "some tests will skip: as root, apt-get install $(SYSTEM_LIBRARIES)"; fi; \
	fi
