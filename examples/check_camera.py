"""Check a camera, of your own or not: pixels to the ground and back, the length of its rays, its sampling of the ground.

python examples/check_camera.py camera.json
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from schemas import InputError, LunargrError
from stages.physics.cameras import Camera, open_camera

HEIGHTS = (-2000.0, 0.0, 5000.0)  # m: a camera that is right at one height alone is none
WITHIN_PX = 1e-3
GRID = 41  # pixels a side


def check(camera: Camera) -> tuple[float, float]:
    """(largest ground distance of a pixel from where its ground is seen, px; metres a pixel in the middle).

    On the ground, because framelets overlap: two pixels may rightly show the same place. Raises InputError.
    """
    line, sample = np.meshgrid(
        np.linspace(0.5, camera.lines - 0.5, GRID), np.linspace(0.5, camera.samples - 0.5, GRID), indexing="ij"
    )
    _, direction = camera.rays(line, sample)
    length = np.linalg.norm(direction, axis=-1)
    if direction.shape != (*line.shape, 3) or np.nanmax(np.abs(length - 1)) > 1e-9:
        raise InputError(
            f"{camera.kind}: expected unit directions {(*line.shape, 3)} of `rays`, found {direction.shape}."
        )
    middle = camera.lines / 2, camera.samples / 2
    near = camera.image_to_ground(
        np.array([middle[0], middle[0]]), np.array([middle[1], middle[1] + 1]), missing="nearest"
    )
    sampling = float(np.linalg.norm(near[1] - near[0]))
    worst = 0.0
    for height in HEIGHTS:
        points = camera.image_to_ground(line, sample, height)
        points = points[np.isfinite(points).all(axis=-1)]
        if not len(points):
            raise InputError(
                f"{camera.kind}: expected pixels that see the body {height:g} m above its sphere, found none."
            )
        again = camera.image_to_ground(*camera.ground_to_image(points), height)
        away = np.linalg.norm(again - points, axis=-1) / sampling
        if not (np.isfinite(away).all() and away.max() < WITHIN_PX):
            raise InputError(
                f"{camera.kind}: expected `ground_to_image` to undo `rays` within {WITHIN_PX:g} px, found pixels "
                f"{np.nanmax(away, initial=np.inf if not np.isfinite(away).any() else 0):.3g} px away, {height:g} m above the sphere."
            )
        worst = max(worst, float(away.max()))
    return worst, sampling


def main(path: Path) -> None:
    camera = open_camera(path)
    worst, sampling = check(camera)
    print(f"{path}: {camera.kind}, {camera.lines} x {camera.samples} px, {sampling:.4g} m a pixel in the middle")
    for note in camera.notes:
        print(f"note: {note}")
    print(f"round trip at {', '.join(f'{h:g}' for h in HEIGHTS)} m: {worst:.1e} px")


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]))
    except LunargrError as error:
        print(error, file=sys.stderr)
        raise SystemExit(3) from None
