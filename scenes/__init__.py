"""Scene files that ship with the program."""
