"""Makes data sets. A file that cannot be used raises a ``DataError`` with file, field and remedy, whoever reads it."""
