"""Command `python -m tasks.experiments NAME`."""

from tasks.command import run
from tasks.experiments.runner import main

if __name__ == "__main__":
    run(main)
