"""The scripts in `examples/` run as they are, and say what their docstrings promise."""

from __future__ import annotations

import math
import runpy

import pytest
from camera_rays import looking_at
from conftest import ROOT

from schemas import InputError
from stages.physics.cameras import Camera

MOON = 1737400.0


@pytest.mark.parametrize(
    ("script", "says"),
    [
        ("new_effect", "haze 0.002"),
        ("new_effect_per_image", "motion_blur with"),
        ("new_camera", "round trip"),
        ("new_matcher", "moved by 2.0, 0.0 px"),
    ],
)
def test_example_runs(script, says, capsys):
    runpy.run_path(str(ROOT / "examples" / f"{script}.py"), run_name="__main__")
    assert says in capsys.readouterr().out


def looking_down(wrong: str | None = None) -> Camera:
    """A pinhole 100 km above the ground, right or with one mistake."""
    camera = looking_at([MOON + 1e5, 0, 0], [MOON, 0, 0], math.radians(20), (200, 300))

    class Mistaken(type(camera)):
        def rays(self, line, sample):
            origin, direction = super().rays(line, sample)
            return origin, direction * (2.0 if wrong == "length" else 1.0)

        def ground_to_image(self, points):
            line, sample = super().ground_to_image(points)
            line, sample = (sample, line) if wrong == "swapped" else (line, sample)
            return (line + 0.5, sample) if wrong == "half a pixel" else (line, sample)

    return Mistaken(**vars(camera))


def test_a_camera_that_is_right_passes_its_check():
    worst, sampling = runpy.run_path(str(ROOT / "examples" / "check_camera.py"))["check"](looking_down())
    assert worst < 1e-6
    assert sampling == pytest.approx(1e5 * 2 * math.tan(math.radians(10)) / 200, rel=0.01)  # similar triangles


@pytest.mark.parametrize("wrong", ["length", "swapped", "half a pixel"])
def test_a_camera_with_a_mistake_does_not(wrong):
    check = runpy.run_path(str(ROOT / "examples" / "check_camera.py"))["check"]
    with pytest.raises(InputError, match="expected unit directions" if wrong == "length" else "undo `rays`"):
        check(looking_down(wrong))
