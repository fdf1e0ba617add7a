"""Several stages in a row, as one: they call stages, which never call each other."""
