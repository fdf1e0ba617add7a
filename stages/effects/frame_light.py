"""Light that strays inside a camera lies over each image as a field of its own."""

from __future__ import annotations

from stages.effects.base import Survey, register
from stages.effects.frame_field import FrameField


@register
class FrameLight(FrameField):
    name = "frame_light"
    listed = False
    title = "a broad field of its own in each image, as light that strays inside a camera leaves it"
    mechanism = (
        "A bright body outside the field of view, or the sunlit limb in it, sends light over the detector by way of baffles and lenses: other light in "
        "every image, broad in each. Beside an image's own brightness it is told like a response that varies over a frame, but in calibrated images, "
        "which have no such response."
    )
    reference = "Mahanti et al. (2016), Space Sci. Rev. 200, 393 (stray light)"
    separate = "images of the same ground with the bright body on the other side"

    @classmethod
    def visible(cls, survey: Survey, has: frozenset[str]) -> bool:
        return survey.units != "dn"
