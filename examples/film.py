"""The views of a trajectory as a film: animated WebP or MP4, one contrast for all of it.

lunargr render svbrdf.h5 --trajectory examples/trajectory.csv --sun-azimuth 90 --sun-elevation 25 -o views/
python examples/film.py views/ film.webp --rate 12
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from stages.render.pictures import read_exr, stretch


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of 'lunargr render --trajectory'; its EXR files in order of name")
    parser.add_argument("film", type=Path, help="NAME.webp or NAME.mp4")
    parser.add_argument("--rate", type=float, default=12.0, help="pictures per second")
    given = parser.parse_args()
    files = sorted(given.folder.glob("*.exr"))
    if not files or given.film.suffix not in (".webp", ".mp4"):
        print("film.py: expected a folder with EXR files, and a film named .webp or .mp4", file=sys.stderr)
        return 3
    images = [read_exr(path)["image"] for path in files]
    sample = np.concatenate([image.ravel()[::31] for image in images])
    _, limits = stretch(sample[None])
    frames = [stretch(np.nan_to_num(image), limits)[0] for image in images]
    if given.film.suffix == ".webp":
        first, *rest = (Image.fromarray(frame).convert("RGB") for frame in frames)
        first.save(given.film, save_all=True, append_images=rest, duration=round(1000 / given.rate), loop=0, quality=82)
    else:
        height, width = frames[0].shape
        writer = cv2.VideoWriter(str(given.film), cv2.VideoWriter_fourcc(*"mp4v"), given.rate, (width, height), False)
        for frame in frames:
            writer.write(frame)
        writer.release()
    print(f"{given.film}: {len(frames)} pictures, {len(frames) / given.rate:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
