"""The lunargr command line."""
