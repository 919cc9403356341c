#!/usr/bin/env bash
# mujoco 4.0.0, upgraded by pip from mujoco 3.3.7 (Python 3.11, Linux x86-64, 2026-11-29).
#
# MuJoCo 4 is split into mujoco, mujoco-core and mujoco-studio. After the upgrade the import fails,
# because pip removes files of the old package after it has written the new ones to the same paths.
# The message has a command that is to repair it. That command names no versions and forbids
# dependencies, so pip takes the newest of each: mujoco 4.0.0 and mujoco-core 4.0.1, of which no mujoco
# is published. The next import fails, too: a mismatch of versions, with another command, which works.
#
# Expected: the first command repairs the environment. Seen:
#
#     after the upgrade: core bindings are missing or corrupted
#     after its remedy: Version mismatch between 'mujoco' (4.0.0) and 'mujoco-core' (4.0.1)
#     after the second remedy: 4.0.0
#
# This script ends with status 1 where that is no longer so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
pip() { "$folder/venv/bin/pip" install -q --disable-pip-version-check "$@" 2>/dev/null; }
try() { "$folder/venv/bin/python" -c 'import mujoco; print("version", mujoco.__version__)' 2>&1 || true; }
expect() {  # a time, a pattern that the import is to show then
  local shown
  shown=$(try)
  grep -E "ImportError|^version" <<< "$shown" | sed "s/^/$1: /"
  grep -qE "$2" <<< "$shown" || { echo "changed: no '$2' $1"; exit 1; }
}

pip mujoco==3.3.7
pip --upgrade mujoco==4.0.0
expect "after the upgrade" "missing or corrupted"
grep -q "pip install --force-reinstall --no-deps mujoco mujoco-core mujoco-studio" <<< "$(try)"
pip --force-reinstall --no-deps mujoco mujoco-core mujoco-studio
expect "after its remedy" "Version mismatch"
pip --upgrade mujoco==4.0.0 mujoco-core==4.0.0 mujoco-studio==4.0.0
expect "after the second remedy" "^version 4\.0\.0"
