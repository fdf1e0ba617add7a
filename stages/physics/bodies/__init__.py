"""Bodies: their spheres, where they are and how they are turned."""
