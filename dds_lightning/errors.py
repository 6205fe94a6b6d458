"""The one exception that means: the user can mend this."""


class UserError(ValueError):
    """A mistake in a flag, a file or a setting that the user can mend.

    The message names the field, the value found, what was expected and what to do. The command line prints it
    without a traceback and exits with status 2.
    """
