"""Settings shared by all tests."""

from hypothesis import settings

# The first example of a property pays for compilation: no deadline. Every run tries the same examples.
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")
