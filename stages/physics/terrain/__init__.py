"""A terrain with its reflectance under a Sun: geometry, visibility of the Sun and shading, window by window."""
