"""`python -m sharpfield` is the command line."""

from sharpfield.cli.commands import main

main()
