"""The ISD of a push-frame camera on a circular orbit."""

from __future__ import annotations

import math

import numpy as np

STEP = 0.1  # s between framelets
FOCAL_PX = 500.0


def isd(
    radius=1e6, orbit=1.05e6, rate=0.012, framelets=30, height=16, overlap=2, samples=16, body=None, sun=None, **changes
):
    """A camera that looks straight down from a circular orbit in the plane y = 0, from +x towards -z; rate in rad/s.

    body : (w, x, y, z) of the rotation from the orbit's axes to the body's; changes : of the ISD's keys
    """
    times = 1000.0 + (np.arange(framelets) - framelets / 2) * STEP
    angles = rate * (times - times[0])
    half = (angles + math.pi / 2) / 2
    document = {
        "name_model": "USGS_ASTRO_PUSH_FRAME_SENSOR_MODEL",
        "center_ephemeris_time": 1000.0,
        "starting_ephemeris_time": times[0] - 0.025,
        "exposure_duration": 0.05,
        "interframe_delay": STEP,
        "framelet_height": height,
        "num_lines_overlap": overlap,
        "framelets_flipped": False,
        "framelet_order_reversed": False,
        "detector_sample_summing": 1,
        "detector_line_summing": 1,
        "focal2pixel_lines": [0.0, 10.0, 0.0],  # the camera's z axis points up: it looks along (x, y, -f)
        "focal2pixel_samples": [0.0, 0.0, -10.0],
        "focal_length_model": {"focal_length": FOCAL_PX / 10},
        "image_lines": framelets * height,
        "image_samples": samples,
        "detector_center": {"line": height / 2, "sample": samples / 2},
        "starting_detector_line": 0,
        "starting_detector_sample": 0,
        "optical_distortion": {"radial": {"coefficients": [0.0, 0.0, 0.0]}},
        "radii": {"semimajor": radius / 1e3, "semiminor": radius / 1e3, "unit": "km"},
        "instrument_position": {
            "unit": "m",
            "positions": np.stack([orbit * np.cos(angles), 0 * angles, -orbit * np.sin(angles)], axis=1).tolist(),
            "velocities": (
                orbit * rate * np.stack([-np.sin(angles), 0 * angles, -np.cos(angles)], axis=1)
            ).tolist(),
            "ephemeris_times": times.tolist(),
        },
        "instrument_pointing": {
            "quaternions": np.stack([np.cos(half), 0 * half, -np.sin(half), 0 * half], axis=1).tolist(),
            "ephemeris_times": times.tolist(),
        },
        "body_rotation": {"quaternions": [body or [1.0, 0.0, 0.0, 0.0]], "ephemeris_times": [1000.0]},
        "sun_position": {
            "unit": "km",
            "positions": [[1e5] * 3, [1.5e5] * 3, [2e5] * 3, [2.5e5] * 3] if sun is None else [sun],
            "velocities": [[125000.0] * 3] * 4 if sun is None else [[0.0] * 3],
            "ephemeris_times": [999.2, 999.6, 1000.0, 1000.4] if sun is None else [1000.0],
        },
    }  # fmt: skip
    return document | changes
