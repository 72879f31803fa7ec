"""`python -m service`: the command line, for callers that must not depend on what PATH finds."""

import sys

from service.cli import main

if __name__ == "__main__":
    sys.exit(main())
