# SPDX-License-Identifier: Apache-2.0
# make demo | test | bench | test-numpy1 | clean        (PYTHON=python3.12 chooses the interpreter)

PYTHON ?= python3
VENV ?= .venv
VENV1 ?= .venv-numpy1
PY := $(VENV)/bin/python
PY1 := $(VENV1)/bin/python
PIP_FLAGS ?= --quiet --disable-pip-version-check
PIP := -m pip install $(PIP_FLAGS)
export PIP_NO_INPUT := 1
export MPLBACKEND := Agg

.PHONY: help demo test bench test-numpy1 clean
.DELETE_ON_ERROR:

help:
	@echo "make demo         real stereo pairs, offline and live, and a generated room; tables and pictures in out/demo"
	@echo "make test         everything continuous integration checks"
	@echo "make bench        accuracy and time tables, cost of the live node"
	@echo "make test-numpy1  the tests on NumPy 1.26 and OpenCV 4 (what an apt robot has)"
	@echo "make clean        remove virtual environments, builds and outputs"

demo: $(VENV)/.demo
	$(PY) -m bench.demo --out out/demo

test: $(VENV)/.test
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	# a file at a time: tests of the node mostly wait; one thread each: two on two cores would wait for each other
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(PY) -m pytest -n 2 --dist loadfile --cov --cov-report=term

bench: $(VENV)/.test
	$(PY) -m bench.speed
	$(PY) -m bench.run
	$(PY) -m bench.run --methods ablations --depth monocular,demo_net --starts disturbed --limit 40 --out out/ablations
	$(PY) -m bench.live

test-numpy1: $(VENV1)/.test
	$(PY1) -m pytest

clean:
	rm -rf $(VENV) $(VENV1) build dist install log out *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	rm -f .coverage .coverage.*

# --- virtual environments: a stamp per set of requirements, so a second run installs nothing ---------------------

define make_venv
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' || \
	  { echo "make: error: '$(PYTHON)' is not Python 3.11 or 3.12; name one with: make PYTHON=python3.11 $(MAKECMDGOALS)" >&2; exit 1; }
	@$(PYTHON) -m venv $(1) || \
	  { echo "make: error: '$(PYTHON) -m venv' failed; on Debian or Ubuntu: apt-get install python3-venv" >&2; exit 1; }
endef

# torch first and alone: by far the largest download, and nothing else may choose its version.
$(VENV)/.core: requirements.txt setup.py
	$(call make_venv,$(VENV))
	$(PY) $(PIP) "$$(grep '^torch==' requirements.txt)"
	$(PY) $(PIP) -r requirements.txt
	$(PY) $(PIP) --no-deps -e .
	@touch $@

# Only stereodemo's recorded images are used, so none of what its programs need, nor their Python versions, matters.
$(VENV)/.demo: requirements-ros.txt $(VENV)/.core
	$(PY) $(PIP) --no-deps --ignore-requires-python stereodemo==0.7
	$(PY) $(PIP) "$$(grep '^trimesh==' requirements-test.txt)" "$$(grep '^embreex==' requirements-test.txt)"
	@$(PY) $(PIP) -r requirements-ros.txt || \
	  echo "make: note: no ROS 2 wheels for this machine (x86_64 only); the demo leaves out its live part" >&2
	@touch $@

$(VENV)/.test: requirements-test.txt requirements-ros.txt $(VENV)/.core
	$(PY) $(PIP) -r requirements-test.txt -r requirements-ros.txt
	@$(call open3d_libraries,$(PY))
	@$(PY) -c 'import rclpy, sensor_msgs.msg'  # tests skip what is missing: here nothing may be
	@touch $@

$(VENV1)/.test: requirements-numpy1.txt requirements-ros.txt setup.py
	$(call make_venv,$(VENV1))
	$(PY1) $(PIP) "$$(grep '^torch==' requirements-numpy1.txt)"
	$(PY1) $(PIP) -r requirements-numpy1.txt -r requirements-ros.txt
	$(PY1) $(PIP) --no-deps -e .
	@$(PY1) -c 'import rclpy, sensor_msgs.msg'
	@touch $@

# open3d needs libusb, which small images lack.
define open3d_libraries
$(1) -c 'import open3d' >/dev/null 2>&1 || { \
  if command -v apt-get >/dev/null && [ "$$(id -u)" = 0 ]; then \
    apt-get update -qq && apt-get install -y -qq libusb-1.0-0 libgomp1 libgl1 >/dev/null; \
  fi; \
  $(1) -c 'import open3d' || echo "make: note: open3d does not import (libusb-1.0-0?); its comparisons are skipped" >&2; }
endef
