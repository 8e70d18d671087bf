"""Physics that needs no learning: see `contact`."""
