"""`stages.render.Renderer`: views as arrays, the same as the command's, with what they share computed once."""

from __future__ import annotations

import numpy as np
import pytest
from render_scene import LAT, LON

from schemas.errors import ConfigError, GeometryError, InputError
from stages import render
from stages.physics.cameras.pinhole import Pinhole
from stages.render.pictures import read_exr

SUN = {"sun_azimuth_deg": 100.0, "sun_elevation_deg": 35.0}
POSE = {"position": (LON + 0.001, LAT - 0.002, 2500.0), "look_at": (LON, LAT), "fov_deg": 10.0, "size_px": (60, 40)}


def test_a_frame_is_what_the_command_writes_however_often_it_is_asked_for(hilly_map, tmp_path):
    path, *_ = hilly_map
    config = render.Config(view="pinhole", **POSE, **SUN)
    render.run(path, tmp_path / "view.exr", config)
    written = read_exr(tmp_path / "view.exr")
    with render.Renderer(path) as renderer:
        wide = {**POSE, "position": (LON, LAT, 9000.0), "fov_deg": 20.0}
        frames = [renderer.view(pose, SUN) for pose in (POSE, wide, POSE)]
        document = renderer.view(frames[0].camera.to_document(), SUN)
    assert isinstance(frames[0].camera, Pinhole) and not np.array_equal(
        frames[1].depth, frames[0].depth, equal_nan=True
    )
    for frame in (frames[0], frames[2], document):
        for name in ("image", "depth", "longitude_deg", "latitude_deg", "incidence_deg", "shadow"):
            # grown grounds have charts of their own, true to 0.005 pixels
            np.testing.assert_allclose(getattr(frame, name), written[name], rtol=2e-3, atol=2e-3, err_msg=name)


def test_horizons_and_pyramids_are_made_once(hilly_map, monkeypatch):
    from stages.render import grounds, setup

    made = []
    for module, name in ((setup, "SunHorizon"), (grounds, "build_height_field")):
        original = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *a, f=original, n=name: (made.append(n), f(*a))[1])
    with render.Renderer(hilly_map[0], samples=1) as renderer:
        for _ in range(3):
            renderer.view(POSE, SUN)
        assert sorted(made) == ["SunHorizon", "build_height_field"]
        renderer.view(POSE, {**SUN, "sun_azimuth_deg": 200.0})
        renderer.view(POSE, SUN)
    assert sorted(made) == ["SunHorizon", "SunHorizon", "build_height_field"]


def test_coarse_ground_does_not_depend_on_the_views_before(hilly_map):
    """Means of blocks that are counted from the map's corner."""
    far = {**POSE, "position": (LON, LAT, 60000.0), "fov_deg": 0.6, "size_px": (20, 20)}
    aside = {**far, "look_at": (LON + 0.002, LAT + 0.0013)}
    with render.Renderer(hilly_map[0], samples=1) as renderer:
        alone = renderer.view(aside, SUN)
    with render.Renderer(hilly_map[0], samples=1) as renderer:
        renderer.view(far, SUN)
        after = renderer.view(aside, SUN)
    np.testing.assert_allclose(after.image, alone.image, rtol=1e-3)


@pytest.mark.parametrize(
    ("pose", "sun", "error", "words"),
    [
        ({"positon": (LON, LAT, 100.0)}, SUN, InputError, "unknown key 'positon', did you mean 'position'"),
        ({**POSE, "position": (LON, LAT, float("nan"))}, SUN, ConfigError, "'position': expected finite numbers"),
        ({**POSE, "size_px": (0, 3)}, SUN, ConfigError, "'size_px': expected"),
        ({"fov_deg": 10.0}, SUN, ConfigError, "expected `position`"),
        (POSE, {"time": 3}, ConfigError, "'time': expected a UTC time"),
        (POSE, {"sun_azimuth_deg": 3.0}, ConfigError, "Sun"),
        (POSE, None, ConfigError, "Sun"),
        ({**POSE, "look_at": (LON + 90, LAT)}, SUN, GeometryError, "the view misses"),
    ],
)
def test_a_view_that_cannot_be_is_refused_and_the_next_one_comes(hilly_map, pose, sun, error, words):
    with render.Renderer(hilly_map[0], samples=1) as renderer:
        with pytest.raises(error, match=words):
            renderer.view(pose, sun)
        assert np.isfinite(renderer.view(POSE, SUN).depth).any()


def test_a_setting_that_cannot_be_is_refused(hilly_map):
    with pytest.raises(InputError, match="unknown key 'sample', did you mean 'samples'"):
        render.Renderer(hilly_map[0], sample=1)
    with pytest.raises(ConfigError, match="expected rays per pixel"):
        render.Renderer(hilly_map[0], samples=0)
