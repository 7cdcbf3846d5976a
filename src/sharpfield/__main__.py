"""`python -m sharpfield` is the command line."""

from sharpfield.cli.main import main

main()
