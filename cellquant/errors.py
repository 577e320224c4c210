"""The one exception that means: the input or an option is wrong, and here is the remedy."""


class InputError(ValueError):
    """The user's input or options are wrong.

    The message is one sentence that names the file, frame or field, what was found there, and
    the remedy. The command line prints it without a traceback and exits with code 2.
    """
