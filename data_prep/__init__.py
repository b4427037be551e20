"""Makes data sets.

A file that cannot be used raises a ``DataError`` with file, field and remedy, an option that does not suit a
``ConfigError`` with its name, a scene or a selection of no use a ``SceneError``, whoever reads it.
"""
