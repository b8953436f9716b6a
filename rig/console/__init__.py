"""The operator's console: a window in a process of its own that watches, commands and replays runs."""
