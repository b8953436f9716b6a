"""Bench files that ship with the program."""
