"""Camera models, one file each, behind a registry."""
