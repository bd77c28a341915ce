# Two commands are enough: `make open` and `make test`. Each sets up what it needs, once: a virtual
# environment in .venv, the tested versions from constraints.txt, a Vulkan driver for SAPIEN where there is
# none, Chromium for the tests. What is there already is left alone, so the second time is quick.
#
#   make open TASK=path/to/task.py ARGS="--num-envs 4 --port 8123"
#   make test ARGS="-k camera"
#   make mutants MODULES="page/door/access envs/snapshots/snapshot"

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help open test test-all test-order test-gpu gpu-wheels mutants lint wheel doctor clean set-up set-up-test FORCE

TASK ?= tasks/push_cube.py
ARGS ?=
MODULES ?= all
# Processes that run the tests, a file of tests each: a third of the time goes into waiting for a browser or a worker.
# A third process would not help two cores: tried, and the tests in a browser took as much longer as others gained.
# The files keep their order: by number of tests, as xdist has it, those of one long test come last and leave a core idle.
WORKERS ?= 2
SEED := $(or $(SEED),$(shell echo $$RANDOM))
# MANISKILL=nightly: ManiSkill's nightly build in place of its release, in an environment of its own.
MANISKILL ?= release
ifeq ($(MANISKILL),release)
VENV := .venv
EXTRA := maniskill
else ifeq ($(MANISKILL),nightly)
VENV := .venv-nightly
EXTRA := nightly
else
$(error MANISKILL is release or nightly, not "$(MANISKILL)")
endif
BIN := $(VENV)/bin
# Without compiling: half of the time, for modules of which two thirds are never imported. Python does it when it imports one,
# unless it is told not to, as in many containers: then each process compiles three thousand files again, and its imports
# take three times as long. What cannot be imported here is told by the command that needs it.
unexport PYTHONDONTWRITEBYTECODE
COMPILE := $(BIN)/python -c 'import workbench.app.worker.main_loop, workbench.app.live_page' >/dev/null 2>&1 || true
PIP_INSTALL := $(BIN)/python -m pip install --disable-pip-version-check -q --no-compile -c constraints.txt

# The first Python that runs and that every pinned package has a release for. A pyenv shim can be on PATH and
# still not run, so each is asked.
PYTHON ?= $(shell for p in python3 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null && echo $$p && break; \
	done)

# The one that has a torch with CUDA, where several do.
GPU_PYTHON ?= $(PYTHON)

# A .venv whose interpreter is gone (the system's Python was upgraded) is made anew.
ifneq ($(wildcard $(VENV)/pyvenv.cfg),)
BROKEN_VENV := $(shell $(BIN)/python -c '' 2>/dev/null || echo FORCE)
endif

help:
	@echo "make open      show tasks/push_cube.py in the browser (TASK=file or env id, ARGS=options of workbench open)"
	@echo "make test      lint, types and the tests that need no GPU and little time (ARGS=options of pytest)"
	@echo "make test-fast ruff and the quickest of the tests that need no process, renderer or browser: about a minute"
	@echo "make test-all  the slow tests too"
	@echo "make test-order all of them in random order, with new examples of the property tests (SEED=1 makes one order again)"
	@echo "make test MANISKILL=nightly  the same tests with ManiSkill's nightly build, in .venv-nightly; likewise make open"
	@echo "make mutants   would a test notice? Slips are planted in copies of MODULES (page/door/access ..., or all)"
	@echo "make test-gpu  on a machine with CUDA: what of GPU simulation and GPU pictures works, within 8 minutes"
	@echo "               (without a network: WHEELS=DIR, filled by make gpu-wheels WHEELS=DIR elsewhere, and PHYSX_GPU=FILE)"
	@echo "make lint      ruff and pyright, the tests' types too"
	@echo "make wheel     dist/*.whl"
	@echo "make doctor    what this machine can do, and what to do about the rest"
	@echo "make clean     remove what building and testing left; .venv stays"

open: set-up
	@env_lines=$$($(BIN)/python -m workbench.machine.software_vulkan --export); eval "$$env_lines"; \
	exec $(BIN)/workbench open $(TASK) $(ARGS)

test: lint
	@env_lines=$$($(BIN)/python -m workbench.machine.software_vulkan --export); eval "$$env_lines"; \
	$(BIN)/python -m pytest -m "not slow" -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

test-fast: set-up-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m pytest --fast -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

test-all: lint
	@env_lines=$$($(BIN)/python -m workbench.machine.software_vulkan --export); eval "$$env_lines"; \
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

# Whatever a test leaves behind for another is found by an order in which it comes first.
test-order: set-up-test
	@env_lines=$$($(BIN)/python -m workbench.machine.software_vulkan --export); eval "$$env_lines"; \
	echo "this order again: make test-order SEED=$(SEED)"; \
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder --random-order-seed=$(SEED) \
	  --hypothesis-profile=new-examples --hypothesis-seed=$(SEED) $(ARGS)

test-gpu:
	@if [ -z "$(GPU_PYTHON)" ]; then echo "test-gpu needs Python 3.11 or 3.12; name one: make test-gpu GPU_PYTHON=/path/to/python3.12" >&2; exit 1; fi
	@$(GPU_PYTHON) tests/gpu/run.py $(if $(WHEELS),--wheels "$(WHEELS)") $(if $(PHYSX_GPU),--physx-gpu "$(PHYSX_GPU)") $(ARGS)

gpu-wheels:
	@if [ -z "$(WHEELS)" ]; then echo "Which folder? Type: make gpu-wheels WHEELS=DIR" >&2; exit 1; fi
	@$(MAKE) --no-print-directory set-up
	@$(BIN)/python tests/gpu/run.py --fetch --wheels "$(WHEELS)" $(if $(FOR_PYTHON),--for-python $(FOR_PYTHON)) $(ARGS)

mutants: set-up-test $(VENV)/.installed-mutants
	@env_lines=$$($(BIN)/python -m workbench.machine.software_vulkan --export); eval "$$env_lines"; \
	$(BIN)/python -m tests.mutants $(MODULES) $(ARGS)

lint: set-up-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
# The types are those of the release.
	$(if $(filter release,$(MANISKILL)),$(BIN)/pyright --threads $(WORKERS))

wheel: set-up-test
	$(BIN)/python -m build --wheel

doctor: set-up
	@$(BIN)/python -m workbench.machine.doctor

clean:
	rm -rf dist build test-results .pytest_cache .ruff_cache .hypothesis
	find . \( -path './.venv*' \) -prune -o -name __pycache__ -type d -print0 | xargs -0 -r rm -rf

set-up: $(VENV)/.installed

set-up-test: $(VENV)/.installed-test
	@$(BIN)/python -m tests.drive.bring_browser

$(VENV)/pyvenv.cfg: $(BROKEN_VENV)
	@if [ -z "$(PYTHON)" ]; then \
		echo "Workbench needs Python 3.11 or 3.12 and found neither as python3, python3.12 nor python3.11." >&2; \
		echo "Install one (Debian 12 and Ubuntu 24.04 have one as python3), or name it: make PYTHON=/path/to/python3.12" >&2; \
		exit 1; \
	fi
	@if ! $(PYTHON) -c 'import ensurepip' 2>/dev/null; then \
		package=$$($(PYTHON) -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'); \
		if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
			apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -y -q $$package; \
		else \
			echo "$(PYTHON) cannot make virtual environments. Type: sudo apt-get install $$package" >&2; exit 1; \
		fi; \
	fi
	$(PYTHON) -m venv --clear $(VENV)

$(VENV)/.installed: $(VENV)/pyvenv.cfg pyproject.toml constraints.txt
	@echo "Installing into $(VENV): some minutes the first time, nothing the next."
	$(PIP_INSTALL) -e '.[$(EXTRA)]'
	@$(COMPILE)
	@touch $@

$(VENV)/.installed-test: $(VENV)/pyvenv.cfg pyproject.toml constraints.txt
	@echo "Installing into $(VENV): some minutes the first time, nothing the next."
	$(PIP_INSTALL) -e '.[$(EXTRA),test]'
	@$(COMPILE)
	@touch $(VENV)/.installed $@

$(VENV)/.installed-mutants: $(VENV)/pyvenv.cfg pyproject.toml constraints.txt
	$(PIP_INSTALL) -e '.[$(EXTRA),mutants]'
	@touch $@

FORCE:
