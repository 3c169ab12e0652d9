"""Command line ``r5dgs``: arguments and functions of every command."""
