"""Image formation, from terrain to detector."""
