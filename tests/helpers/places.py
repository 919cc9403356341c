"""Where the checkout is, and what a Python started by a test finds its modules in."""

import os
from pathlib import Path

#: The checkout.
ROOT = Path(__file__).parents[2]
#: This folder.
HELPERS = Path(__file__).parent
#: A folder whose ``warp`` cannot be imported, for processes that have no use for it.
WITHOUT_WARP = HELPERS / "without_warp"
#: PYTHONPATH of a process that imports the package of the checkout and these helpers.
PYTHONPATH = os.pathsep.join(map(str, [WITHOUT_WARP, HELPERS, ROOT]))
