"""Campaign files that ship with the program."""
