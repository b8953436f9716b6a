"""One module per command: ``add_arguments(parser)`` and ``run(arguments) -> int``.

The modules import only argparse at the top; whatever a command needs is imported when it runs.
"""

SCENE = "scene file, or the name of one that ships"
BENCH = "bench file, or the name of one that ships"
