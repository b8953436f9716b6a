"""The emulated bench: one plant behind wire-level emulators of every instrument."""
