"""Command that kicks the ball straight ahead."""

from functools import partial

from tasks import kick
from tasks.command import run

TARGET = (4.0, 0.0, 0.5)

if __name__ == "__main__":
    run(partial(kick.main, target=TARGET))
