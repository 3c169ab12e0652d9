"""The command line `r5dgs`: arguments and functions of each command."""
