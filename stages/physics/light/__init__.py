"""Light: the Sun's disc, the sky, the terrain around, the Earth."""
