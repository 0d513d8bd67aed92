# Two commands on a fresh machine: `make demo` (the main job) and `make test`.
# Needed: Python with venv, and make. No root. Everything lands in .uv/ and .venv/ of this folder.
# PyBullet is compiled (PYBULLET=source) where there is a C++ compiler; PYBULLET=wheel takes a fork that is compiled already.

SHELL := /bin/bash
DEMO ?= recordings/demo
TEST_WORKERS ?= $(shell n=$$(getconf _NPROCESSORS_ONLN 2>/dev/null || echo 1); echo $$(( n > 4 ? 4 : n )))
# In the order of their names: pytest-xdist would put files of few tests last, which are those that take long.
IN_PARALLEL = -n $(TEST_WORKERS) --dist loadfile --no-loadscope-reorder
ALONE = -n 0 tests/crash/test_ray.py  # a node of Ray gives up on a machine that is too busy
BIN := .venv/bin
PYBULLET ?= $(or $(patsubst .venv/.stamp-%,%,$(wildcard .venv/.stamp-*)),$(shell command -v c++ g++ >/dev/null && echo source || echo wheel))
STAMP := .venv/.stamp-$(PYBULLET)

# Containers often set this; every process would then compile LeRobot's and PyTorch's modules again, for 10 s each.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo sample test test-slow test-long setup lint docs constraints clean

demo: $(STAMP)
	@echo "Generating five episodes into $(DEMO)"
	@$(BIN)/generate-dataset --config demo.toml --out $(DEMO)
	@$(BIN)/demorec view $(DEMO) --save $(DEMO)/playback.rrd --overwrite
	@echo "Look at it:  $(BIN)/demorec view $(DEMO)   (or --web in a browser, or $(BIN)/rerun $(DEMO)/playback-*.rrd)"

# The recording in recordings/sample/, after a change of the format.
sample: $(STAMP)
	@folder=$$(mktemp -d) && \
	$(BIN)/generate-dataset --num-episodes 1 --width 128 --height 128 --no-export --out $$folder/run && \
	cp $$folder/run/episodes/episode_000000.mcap recordings/sample/pick_place.mcap; rm -rf $$folder

test: $(STAMP)
	$(BIN)/pytest -m "not slow" $(IN_PARALLEL)

test-slow: $(STAMP)
	$(BIN)/pytest -m "slow and not long" $(IN_PARALLEL) --ignore tests/crash/test_ray.py
	$(BIN)/pytest -m "slow and not long" $(ALONE)

# Before a release: what takes longest, or is more of what test-slow does.
test-long: $(STAMP)
	$(BIN)/pytest -m long -n $(TEST_WORKERS) --ignore tests/crash/test_ray.py
	$(BIN)/pytest -m long $(ALONE)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The pages that are made from the code.
docs: $(STAMP)
	$(BIN)/python tools/names_page.py > docs/api.md

setup: $(STAMP)

# What is installed stays; a change of what it was made from, or of PYBULLET, sets up again.
$(STAMP): pyproject.toml constraints.txt .python-version $(wildcard plugins/*/pyproject.toml)
	@tools/setup.sh $(@:.venv/.stamp-%=%)

# The versions that are installed now become the pinned ones (names and versions only).
constraints:
	@uv=$$(command -v uv || echo .uv/bin/uv); "$$uv" pip freeze -p .venv | grep -E '^[A-Za-z0-9._-]+==' > constraints.txt
	@wc -l constraints.txt

clean:
	rm -rf .venv .uv
