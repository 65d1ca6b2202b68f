"""Command line of the book: ``python -m book._tools``. The Makefile calls it."""
