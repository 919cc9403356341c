#!/usr/bin/env bash
# dm_control 1.0.50 asks for mujoco >= 3.17.0, so pip installs mujoco 4.0.0 beside it, and pip check finds
# nothing wrong. But no task of the suite can be loaded: dm_control looks up each field of mjModel that it
# knows, and MuJoCo 4.0.0 has no flex_vertedge any more. With mujoco 3.17.0, the same program loads it.
# Seen with: Python 3.11. Fails if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
for version in 4.0.0 3.17.0; do
  "$folder/venv/bin/pip" install --quiet dm_control==1.0.50 "mujoco==$version"
  "$folder/venv/bin/pip" check
  MUJOCO_GL=disable "$folder/venv/bin/python" - "$version" <<'PROGRAM'
import sys

from dm_control import suite

try:
    suite.load("pendulum", "swingup")
except AttributeError as error:
    outcome = str(error)
else:
    outcome = "loaded"
print(f"mujoco {sys.argv[1]}: {outcome}")
assert ("flex_vertedge" in outcome) == (sys.argv[1] == "4.0.0")
PROGRAM
done
