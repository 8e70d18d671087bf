"""Command that kicks the ball to the left."""

from functools import partial

from tasks import kick
from tasks.command import run

TARGET = (4.0, 1.2, 0.5)

if __name__ == "__main__":
    run(partial(kick.main, target=TARGET))
