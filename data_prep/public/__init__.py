"""Public data sets of the field: their fields, pictures and pickles, and the writer of our layout."""
