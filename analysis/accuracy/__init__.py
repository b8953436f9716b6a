"""Error against run time of every solver: ``rig accuracy``.

Every module of this package whose name ends in ``_study`` contributes sections through
``sections(quick, progress) -> list[Section]``; a further solver adds a module of its own.
"""
