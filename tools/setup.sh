#!/usr/bin/env bash
# `make setup`: every package into .venv/ (and uv into .uv/, unless an up-to-date one is there), telling what goes on.
# Usage: tools/setup.sh source|wheel: PyBullet compiled here, or the wheel of the fork pybullet-arm64 in its place.
set -euo pipefail

pybullet=$1
uv_minimum=0.8.4
fork=pybullet-arm64==3.2.8
log=$(mktemp)
beat=""
trap 'kill $beat 2>/dev/null || true; rm -f "$log"' EXIT

fail() { echo "make: $*" >&2; exit 1; }

# Every 20 seconds: the time since the start, and what uv has begun and not ended.
heartbeat() {
  while sleep 20 >&- 2>&-; do
    awk -v passed="$SECONDS" '
      $1 == "Resolved" { resolved = 1 }
      $1 == "Prepared" { prepared = 1 }
      $1 == "Warming" { warming = 1 }
      { sub(/==.*/, "", $2) }
      $1 == "Building" { builds[$2] } $1 == "Built" { delete builds[$2] }
      $1 == "Downloading" { loads[$2] } $1 == "Downloaded" { delete loads[$2] }
      END {
        for (name in builds) line = line (line ? ", " : "building ") name
        for (name in loads) if (++count <= 3) names = names (names ? ", " : "downloading ") name
        if (count > 3) names = names " and " count - 3 " more"
        line = line (line && names ? "; " : "") names
        if (!line) line = warming ? "compiling the renderer" : prepared ? "installing" : resolved ? "downloading" : "choosing versions"
        printf "  %d:%02d  %s\n", passed / 60, passed % 60, line
      }' "$log"
  done
}

# A command whose output is shown only when it fails.
quietly() { "$@" >>"$log" 2>&1 || { cat "$log"; fail "setting up failed after $((SECONDS / 60)) min: ${*:1:3} says why above; make again goes on."; }; }

case $pybullet in
  source)
    command -v c++ g++ >/dev/null || fail "no C++ compiler to build PyBullet with was found: install g++ or clang, or use PYBULLET=wheel."
    other=pybullet-arm64 arguments=()
    how="PyBullet is compiled here, the longest part; PYBULLET=wheel takes a compiled fork" ;;
  wheel)
    # A requirement that holds nowhere takes the place of demorec's own for PyBullet.
    echo "pybullet; python_version < '3'" >"$log.override"
    trap 'kill $beat 2>/dev/null || true; rm -f "$log" "$log.override"' EXIT
    other=pybullet arguments=(--override "$log.override" "$fork")
    how="in PyBullet's place its fork $fork, compiled by others" ;;
  *) fail "PYBULLET is '$pybullet', allowed are source and wheel." ;;
esac

heartbeat &
beat=$!
uv=$(command -v uv || true)
if [ -n "$uv" ]; then
  found=$("$uv" --version | cut -d' ' -f2)
  [ "$(printf '%s\n' $uv_minimum "$found" | sort -V | head -n 1)" = $uv_minimum ] || uv=""
fi
if [ -z "$uv" ]; then
  uv=.uv/bin/uv
  if [ ! -x $uv ]; then
    echo "Installing uv into .uv/"
    quietly python3 -m venv .uv
    quietly .uv/bin/python -m pip install -q uv
  fi
fi
echo "Setting up .venv/ (the first time 7 GB with PyTorch and LeRobot; $how)"
plugins=()
for folder in plugins/*/; do plugins+=(-e "$folder"); done
[ -x .venv/bin/python ] || quietly "$uv" venv --allow-existing .venv
rm -f .venv/.stamp*
# Both have the same files: one that is there would take those of the other along when it goes.
quietly "$uv" pip uninstall -p .venv $other
# Python's own flags have -g: debugging information takes a quarter of the compiler's time and 100 MB, and changes no code.
flags=$(.venv/bin/python -c "import sysconfig; print(sysconfig.get_config_var('CFLAGS'))")
export CFLAGS="${CFLAGS-$flags -g0}" CXXFLAGS="${CXXFLAGS-$flags -g0}"
quietly "$uv" pip install -p .venv -c constraints.txt -e . --group dev "${arguments[@]}" "${plugins[@]}"
quietly .venv/bin/python -c "import pybullet"
# It decodes with the machine's FFmpeg. Without one, LeRobot would print 184 lines of tracebacks at each start; with this
# package gone, it decodes with PyAV.
.venv/bin/python -c "import torchcodec" >>"$log" 2>&1 || quietly "$uv" pip uninstall -p .venv torchcodec
echo "Compiling the renderer for this machine"
echo "Warming" >>"$log"
quietly .venv/bin/python -c "from demorec.render.raster import warm_up; warm_up()"
touch .venv/.stamp-"$pybullet"
printf 'Set up in %d:%02d min.\n' $((SECONDS / 60)) $((SECONDS % 60))
