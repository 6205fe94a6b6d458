"""The one exception that means: the user can mend this; and how other errors are told."""

import re

OUT_OF_MEMORY = ("out of memory", "can't allocate memory", "not enough memory", "ALLOC_FAILED")
"""What accelerators, the allocators of torch on Linux and Windows, and cuBLAS say."""


class UserError(ValueError):
    """A mistake in a flag, a file or a setting that the user can mend.

    The message names the field, the value found, what was expected and what to do. The command line prints it
    without a traceback and exits with status 2.
    """


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory is used up: Python's, NumPy's, or torch's on any device."""
    if isinstance(error, RuntimeError):
        return any(mark in str(error) for mark in OUT_OF_MEMORY)
    return isinstance(error, MemoryError)


def reason(error: BaseException) -> str:
    """The first sentence of an error's text without torch's place in its source; its kind where it has no text."""
    text = re.sub(r"^\[enforce fail at [^\]]*\][^.]*\. ", "", str(error)).strip() or type(error).__name__
    return text.splitlines()[0].split(". ", 1)[0].rstrip(".")
