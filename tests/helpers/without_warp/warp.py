"""Is found in place of Warp, as if that were not installed."""

raise ImportError("processes of tests do without Warp")
