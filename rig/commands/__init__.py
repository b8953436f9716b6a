"""One module per command: ``SUMMARY``, ``add_arguments(parser)`` and ``run(arguments) -> int``.

The modules import only argparse at the top; whatever a command needs is imported when it runs.
"""
