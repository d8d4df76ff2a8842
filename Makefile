# `make quickstart` and `make test` each do all the set-up on a fresh machine.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Extra words for pip, such as an index with CPU builds of torch: make quickstart PIP_ARGS="--extra-index-url URL"
PIP_ARGS ?=
# Compiling every module of every package takes a minute and a half; what is imported is compiled then.
INSTALL = $(BIN)/python -m pip install --quiet --no-compile $(PIP_ARGS)
SEED ?= 0
# Processes that share the test files: one more than two cores, for the one that has all Rays mostly waits for them.
TEST_WORKERS ?= 3
METAWORLD := metaworld==3.1.1
ALOHA := dm_control==1.0.41 gym-aloha==0.1.5
OGBENCH := dm_control==1.0.41 ogbench==1.2.2

.PHONY: setup metaworld aloha ogbench gl test test-all lint quickstart smoke controls clean

setup: gl $(VENV)/.ready

$(BIN)/pip:
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 10) else "Worldloop needs Python 3.10 or newer: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV) || { echo "python venv is missing: sudo apt-get install -y python3-venv"; exit 1; }
	$(BIN)/python -m pip install --upgrade pip --quiet

$(VENV)/.ready: pyproject.toml constraints.txt | $(BIN)/pip
	$(INSTALL) -c constraints.txt -e ".[dev,metaworld,aloha]"
	# These two ask for an old numpy and an old mujoco, which nothing in them needs; their real needs are ours.
	# The third and fourth ask for a video encoder and a compiled maze, which we do not use.
	$(INSTALL) --no-deps openpi-client==0.1.2 $(METAWORLD) $(ALOHA)
	touch $@

# One suite alone, for an environment that was set up without it or not at all; ogbench is not part of the set-up.
metaworld: gl | $(BIN)/pip
	$(INSTALL) -c constraints.txt -e ".[metaworld]"
	$(INSTALL) --no-deps $(METAWORLD)

aloha: gl | $(BIN)/pip
	$(INSTALL) -c constraints.txt -e ".[aloha]"
	$(INSTALL) --no-deps $(ALOHA)

ogbench: gl | $(BIN)/pip
	$(INSTALL) -c constraints.txt -e ".[ogbench]"
	$(INSTALL) --no-deps $(OGBENCH)

# OpenGL in software, for rendering without a screen. Installed where we may, else the line to type is printed.
gl:
	@if ldconfig -p 2>/dev/null | grep -q 'libEGL\.so\.1'; then :; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	  apt-get update -qq && apt-get install -y -qq libegl1 libgl1-mesa-dri >/dev/null; \
	elif sudo -n true 2>/dev/null; then sudo apt-get update -qq && sudo apt-get install -y -qq libegl1 libgl1-mesa-dri >/dev/null; \
	else echo "OpenGL is missing; please type: sudo apt-get install -y libegl1 libgl1-mesa-dri"; exit 1; fi

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint
	$(BIN)/python -m pytest -n $(TEST_WORKERS) --dist loadfile

# Also what takes long and proves no more than further variants of what `make test` samples.
test-all: lint
	$(BIN)/python -m pytest -n $(TEST_WORKERS) --dist loadfile -m ""

quickstart: setup
	$(BIN)/worldloop run experiment=quickstart seed=$(SEED)

smoke: setup
	$(BIN)/worldloop run experiment=smoke

controls: setup
	$(BIN)/worldloop controls experiment=quickstart seed=$(SEED)

clean:
	rm -rf runs
