"""Runs the command line: python -m octoseg_ti VERB."""

import sys

from octoseg_ti.cli import main

if __name__ == "__main__":
    sys.exit(main())
