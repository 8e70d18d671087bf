"""The learned parts of a simulator, one a file: see `part`."""
