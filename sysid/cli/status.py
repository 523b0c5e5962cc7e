"""Exit status of the command line: what each number means is said in `sysid.cli.main`."""

SUCCESS, NOT_REACHED, MISTAKE, BUG, INTERRUPTED = 0, 1, 2, 70, 130
