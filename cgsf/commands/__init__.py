"""The subcommands of the command line, one a file; the table of names is in :mod:`cgsf.cli`."""
