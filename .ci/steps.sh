# Sourced by .ci/run and .ci/nightly: timed steps, and a fresh environment in $work/venv.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# Name the step that begins; print the minutes of the one that ends.
minutes() { awk -v seconds="$1" 'BEGIN { printf "%.1f min", seconds / 60 }'; }
step_name="" step_start=$SECONDS step_times=""
step() {
  if [ -n "$step_name" ]; then
    step_times+=$(printf '%-40s %9s' "$step_name" "$(minutes $((SECONDS - step_start)))")$'\n'
  fi
  step_name=$1 step_start=$SECONDS
  printf '\n== %s\n' "$step_name"
}

finish() {
  step "done"
  printf '%s%-40s %9s\n' "$step_times" "total" "$(minutes "$SECONDS")"
}

has_bpy() { python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))'; }

work=$(mktemp -d -t r5dgs-ci.XXXXXX)
trap 'status=$?; rm -rf "$work"; [ "$status" -eq 0 ] || echo "failed in step: $step_name, after $(minutes "$SECONDS")"' EXIT

fresh_environment() {
  step "system libraries of bpy, Node and a browser"
  local libraries=(libx11-6 libxrender1 libxxf86vm1 libxfixes3 libxi6 libxkbcommon0 libsm6 libgl1 libgomp1
             libegl1 libegl-mesa0 libgl1-mesa-dri chromium)
  if ! command -v npm >/dev/null; then libraries+=(nodejs npm); fi
  if ! command -v dpkg-query >/dev/null; then
    echo "not a Debian system: the libraries that bpy needs, Node and Chromium are taken to be installed"
  elif ! dpkg-query -W -f '${Status}\n' "${libraries[@]}" 2>/dev/null | grep -c '^install ok installed$' | grep -qx "${#libraries[@]}"; then
    local root=()
    if [ "$(id -u)" -ne 0 ]; then root=(sudo); fi
    "${root[@]}" apt-get update -qq
    "${root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${libraries[@]}"
  fi

  step "packages of the player"
  npm --prefix player ci --ignore-scripts --no-audit --no-fund
  npm --prefix player run types

  step "fresh environment"
  "${PYTHON:-python3}" -m venv "$work/venv"
  export PATH="$work/venv/bin:$PATH" VIRTUAL_ENV="$work/venv"
  unset PYTHONPATH PYTHONHOME
  export PIP_DISABLE_PIP_VERSION_CHECK=1
  pip install -q -c constraints.txt -e ".[test,dev,docs]"
  python -m pip check
  if has_bpy; then
    python -c "import bpy"  # else the Blender tests would be skipped
  fi
}
