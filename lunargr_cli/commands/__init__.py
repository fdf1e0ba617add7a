"""One thin file per command: NAME, ORDER in the help, and `command` with its options."""
