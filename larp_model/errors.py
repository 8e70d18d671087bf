"""Errors that users cause and can mend, told apart from the program's own."""


class InputError(ValueError):
    """An argument, a file or a setting that cannot be used.

    Its message is one line that names the argument, what it got and what it needs. Commands print it and exit with 2;
    every other exception keeps its traceback.
    """
