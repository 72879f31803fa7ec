"""What a command's exit code tells a script."""

from typing import Final

DONE: Final = 0
FAILURE: Final = 1
WRONG_INPUT: Final = 2
DONE_IN_PART: Final = 3
INTERRUPTED: Final = 130  # what typer itself returns after Ctrl-C
