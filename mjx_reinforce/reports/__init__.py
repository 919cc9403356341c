"""Reports: statistics over seeds, and pictures of them."""
