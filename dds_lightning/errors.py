"""The one exception that means: the user can mend this; and how other errors are told."""

import re
import unicodedata

OUT_OF_MEMORY = ("out of memory", "can't allocate memory", "not enough memory", "ALLOC_FAILED")
"""What accelerators, the allocators of torch on Linux and Windows, and cuBLAS say."""

GREATEST_SEED = 2**32 - 1


LONGEST = 1100
"""Characters of a message; of a longer one, which quotes something without end, beginning and end are kept."""


def printable(text: str) -> str:
    """Replace what a terminal acts on, escape sequences and changes of the direction of writing, by its code."""
    return "".join(
        character if character in "\n\t" or unicodedata.category(character)[0] != "C" else _code(character)
        for character in text
    )


def _code(character: str) -> str:
    return ascii(character)[1:-1]


class UserError(ValueError):
    """A mistake in a flag, a file or a setting that the user can mend.

    The message names the field, the value found, what was expected and what to do. The command line prints it
    without a traceback and exits with status 2. What a terminal would act on is shown as `printable` shows it: messages
    quote names from files of strangers.
    """

    def __init__(self, message: object = "") -> None:
        text = printable(str(message))
        super().__init__(text if len(text) <= LONGEST else f"{text[:700]} ... {text[-300:]}")


def lacks_extra(what: str, extra: str, more: str = "") -> UserError:
    """The error of a package that is not installed.

    It names the checkout and no package of an index: under the name of this project anybody could put one there.

    Args:
        what: What needs which package, as the sentence begins.
        extra: The extra of this project that brings it.
        more: Another command, for a package that no extra can bring.
    """
    command = f"pip install -e '.[{extra}]' -c constraints.txt{more and f' && {more}'}"
    return UserError(f"{what}: run `{command}` in this project's checkout")


class ToldAlreadyError(UserError):
    """A user's mistake that another process, started for this one, has told; the exit status is 2 all the same."""


def refuse_seed(name: str, seed: int) -> None:
    """Refuse a seed that one of the libraries would not take.

    Args:
        name: Of the setting.
        seed: Its value.

    Raises:
        UserError: It is negative or has more than 32 bits, which is NumPy's limit.
    """
    if not 0 <= seed <= GREATEST_SEED:
        raise UserError(f"{name} is {seed}, expected a whole number from 0 to {GREATEST_SEED}")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory is used up: Python's, NumPy's, or torch's on any device."""
    if isinstance(error, RuntimeError):
        return any(mark in str(error) for mark in OUT_OF_MEMORY)
    return isinstance(error, MemoryError)


def reason(error: BaseException) -> str:
    """The first sentence of an error's text without torch's place in its source; its kind where it has no text."""
    text = re.sub(r"^\[enforce fail at [^\]]*\][^.]*\. ", "", str(error)).strip() or type(error).__name__
    return text.splitlines()[0].split(". ", 1)[0].rstrip(".")
