"""Kick the ball straight ahead."""

from functools import partial

from tasks import kick

TARGET = (4.0, 0.0, 0.5)

if __name__ == "__main__":
    kick.run(partial(kick.main, target=TARGET))
