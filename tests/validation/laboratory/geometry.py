"""Where Sun and camera stand: what is drawn for each image, and what follows for each pair.

East, north, up throughout; a plane at the height of the datum, with the scene's centre as its origin, carries the images.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .camera import Camera
from .fields import Array
from .ground import Ground
from .layout import Needs, Sites

MOON = 1737400.0  # m, mean radius
SUN_RADIUS = 0.2666  # degrees, at 1 au


@dataclass
class Sky:
    """For each image: Sun and viewing direction at the scene's centre, degrees."""

    latitude: float
    longitude: float
    elevation: Array
    azimuth: Array
    distance: Array  # au
    oblique: bool
    emission: Array
    view_azimuth: Array
    altitude: Array  # m
    story: str


def draw_sky(rng: np.random.Generator, needs: Needs, images: int, extent: float) -> Sky:
    """Low, high and other Suns; nadir views or oblique ones. `extent` of the scene in m."""
    latitude, longitude = rng.uniform(-55, 55), rng.uniform(0, 360)
    low = rng.uniform(10, 18, size=max(1, images // 6))
    high = rng.uniform(45, 70, size=max(1, images // 6))
    rest = rng.uniform(14, 65, size=images - len(low) - len(high))
    if needs.low_sun:
        low = rng.uniform(10, 14, size=max(2, images // 4))
        rest = rng.uniform(13, 55, size=max(images - len(low) - len(high), 0))
    elevation = np.concatenate([low, high, rest])[:images]
    if rng.random() < 0.5:
        azimuth = (np.arange(images) + rng.random(images) * 0.9) * 360 / images + rng.random() * 360
        kind = "ring"
    else:
        azimuth = np.where(np.arange(images) % 2, 90.0, 270.0) + rng.normal(0, 32, images)
        kind = "east-west"
    azimuth = azimuth[rng.permutation(images)] % 360
    distance = rng.uniform(0.984, 1.016, images)
    oblique = bool(rng.random() < 0.4 if needs.oblique is None else needs.oblique)
    emission = np.abs(rng.normal(0, 3.5, images))
    if oblique:
        tilted = rng.random(images) < 0.65
        tilted[rng.integers(images)] = True
        emission = np.where(tilted, rng.uniform(12, 40, images), emission)
    view_azimuth = rng.random(images) * 360
    # never so near that the view changes much across the scene
    altitude = max(rng.uniform(40e3, 120e3), 6 * extent) * rng.uniform(0.95, 1.05, images)
    story = f"Sun {elevation.min():.0f}..{elevation.max():.0f} deg {kind}, {'oblique' if oblique else 'near nadir'}"
    return Sky(
        latitude, longitude, elevation, azimuth, distance, oblique, emission, view_azimuth, altitude, story
    )  # fmt: skip


def axes(latitude: float, longitude: float) -> Array:
    """(3, 3): rows east, north, up at a place (rad), in Moon-fixed axes."""
    sa, ca, so, co = math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude)
    return np.array([[-so, co, 0], [-sa * co, -sa * so, ca], [ca * co, ca * so, sa]])


def direction(azimuth: float, elevation: float) -> Array:
    """(3,): unit vector east, north, up; azimuth clockwise from north, rad."""
    ce = math.cos(elevation)
    return np.array([math.sin(azimuth) * ce, math.cos(azimuth) * ce, math.sin(elevation)])


@dataclass
class PairGeometry:
    """For each pair: unit vector to the Sun, camera (m from the crop centre at its mean height), place of the crop centre."""

    sun: Array  # (pairs, 3)
    camera: Array  # (pairs, 3)
    latitude: Array  # (pairs,), degrees
    longitude: Array
    centre: Array  # (pairs, 2), m: east, north in the plane
    height: Array  # (pairs,), m: mean of the crop


def pair_geometry(sites: Sites, ground: Ground, sky: Sky, camera: Camera) -> PairGeometry:
    pairs = sites.pairs()
    n = len(pairs)
    found = PairGeometry(
        np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n), np.zeros(n), np.zeros((n, 2)), np.zeros(n)
    )  # fmt: skip
    lat0, lon0 = math.radians(sky.latitude), math.radians(sky.longitude)
    for q, (site, image) in enumerate(pairs):
        # the crop's centre is the corner between its pixels size/2 - 1 and size/2
        x = (sites.col[site] - sites.grid / 2) * ground.gsd
        y = -(sites.row[site] - sites.grid / 2) * ground.gsd
        found.centre[q] = x, y
        lat = lat0 + y / MOON
        lon = lon0 + x / (MOON * math.cos(lat0))
        found.latitude[q], found.longitude[q] = math.degrees(lat), math.degrees(lon) % 360
        fixed = axes(lat0, lon0).T @ direction(math.radians(sky.azimuth[image]), math.radians(sky.elevation[image]))
        sun = axes(lat, lon) @ fixed
        found.sun[q] = sun / np.linalg.norm(sun)
        found.height[q] = sites.crop(ground.pixels, site).mean()
        e, azimuth = math.radians(sky.emission[image]), math.radians(sky.view_azimuth[image])
        altitude = sky.altitude[image]
        above = np.array([math.tan(e) * math.sin(azimuth) * altitude, math.tan(e) * math.cos(azimuth) * altitude])
        if camera.line_scan:  # the camera flies along with the lines
            track = np.linalg.inv(camera.affine[image]) @ np.array([0, 1.0])
            track /= np.linalg.norm(track)
            above = above + track * (np.array([x, y]) @ track)
        found.camera[q] = [above[0] - x, above[1] - y, altitude - (found.height[q] - ground.datum)]
    return found
