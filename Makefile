# Two commands on a fresh machine: `make demo` (the main job) and `make test`.
# Needed: Python with venv, a C++ compiler, make. No root. Everything lands in .uv/ and .venv/ of this folder.

SHELL := /bin/bash
DEMO ?= recordings/demo
UV_MINIMUM := 0.8.4
TEST_WORKERS ?= $(shell n=$$(getconf _NPROCESSORS_ONLN 2>/dev/null || echo 1); echo $$(( n > 4 ? 4 : n )))
BIN := .venv/bin

# Containers often set this; every process would then compile LeRobot's and PyTorch's modules again, for 10 s each.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-slow setup lint constraints clean

demo: .venv/.stamp
	@$(BIN)/generate-dataset --config demo.toml --out $(DEMO)
	@$(BIN)/demorec view $(DEMO) --save $(DEMO)/playback.rrd --overwrite
	@echo "Look at it:  $(BIN)/demorec view $(DEMO)   (or --web in a browser, or $(BIN)/rerun $(DEMO)/playback-*.rrd)"

test: .venv/.stamp
	$(BIN)/pytest -m "not slow" -n $(TEST_WORKERS) --dist loadfile

test-slow: .venv/.stamp
	$(BIN)/pytest -m slow -n $(TEST_WORKERS) --dist loadfile --ignore tests/crash/test_ray.py
	$(BIN)/pytest -m slow -n 0 tests/crash/test_ray.py  # alone: a node of Ray gives up on a machine that is too busy

lint: .venv/.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

setup: .venv/.stamp

# uv is found or installed into .uv/; PyBullet is compiled with NumPy (about three minutes, once: uv keeps the wheel).
.venv/.stamp: pyproject.toml constraints.txt .python-version
	@command -v c++ >/dev/null || command -v g++ >/dev/null || \
	  { echo "make: a C++ compiler is needed to build PyBullet and none was found: install g++ or clang."; exit 1; }
	@set -e; uv=$$(command -v uv || true); \
	if [ -n "$$uv" ]; then found=$$("$$uv" --version | cut -d' ' -f2); \
	  [ "$$(printf '%s\n' $(UV_MINIMUM) "$$found" | sort -V | head -n 1)" = "$(UV_MINIMUM)" ] || uv=""; fi; \
	if [ -z "$$uv" ]; then uv=.uv/bin/uv; \
	  [ -x "$$uv" ] || { echo "Installing uv into .uv/"; python3 -m venv .uv && .uv/bin/python -m pip install -q uv; }; fi; \
	echo "Setting up .venv (the first time about four minutes and 7 GB: PyTorch comes with LeRobot)"; \
	[ -x .venv/bin/python ] || "$$uv" venv -q --allow-existing .venv; \
	"$$uv" pip install -q -p .venv -c constraints.txt -e . --group dev
	@$(BIN)/python -c 'import pybullet, sys; sys.exit(not pybullet.isNumpyEnabled())' >/dev/null 2>&1 || \
	  { echo "make: PyBullet was built without NumPy: run 'make clean', then make again with an up-to-date uv."; exit 1; }
	@$(BIN)/python -c "from demorec.render.warm import warm_up_renderer; warm_up_renderer('raster')"
	@touch .venv/.stamp

# The versions that are installed now become the pinned ones (names and versions only).
constraints:
	@uv=$$(command -v uv || echo .uv/bin/uv); "$$uv" pip freeze -p .venv | grep -E '^[A-Za-z0-9._-]+==' > constraints.txt
	@wc -l constraints.txt

clean:
	rm -rf .venv .uv
