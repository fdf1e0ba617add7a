"""Lunar relief as a function of place: fractal noise, craters and rocks, and what they add below a DEM's pixels."""
