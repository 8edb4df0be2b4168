"""Runs the command line: python -m octoseg_ti VERB."""

from octoseg_ti.cli import program

if __name__ == "__main__":
    program()
