"""Command `python -m tasks.pose`, or `larp-pose`."""

from tasks.pose.command import cli

if __name__ == "__main__":
    cli()
