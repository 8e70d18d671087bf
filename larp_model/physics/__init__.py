"""Physics that needs no learning: see `step`."""
