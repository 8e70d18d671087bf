"""Physics that needs no learning: see `articulated` and `contact`."""
