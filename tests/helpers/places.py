"""Where the checkout is, and what a Python started by a test finds its modules in."""

import os
from pathlib import Path

#: The checkout.
ROOT = Path(__file__).parents[2]
#: This folder.
HELPERS = Path(__file__).parent
#: PYTHONPATH of a process that imports the package of the checkout and these helpers.
PYTHONPATH = os.pathsep.join([str(HELPERS), str(ROOT)])
