"""Lommel-Seeliger's law: light scattered once in a dark, deep layer. A good disk function for the full Moon.

    I/F = albedo 2 cos(i) / (cos(i) + cos(e))

The factor 2 makes the albedo the normal albedo, as in ISIS; in Hapke's terms it is w/8 for isotropic particles.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import ALBEDO, ReflectanceModel, register


@register
class LommelSeeliger(ReflectanceModel):
    name = "lommel_seeliger"
    title = "Lommel-Seeliger"
    formula = "A 2 cos(i) / (cos(i) + cos(e))"
    reference = "Seeliger, H. (1887), Abh. Bayer. Akad. Wiss. 16, 405; with the normal albedo in front as in ISIS"
    reciprocal = True
    linear = True
    parameters = (ALBEDO,)
    glsl = """
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {
  return p[0] * 2.0 * mu0 / (mu0 + mu);
}
"""

    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        mu0 = angles.cos_incidence
        return parameters["albedo"] * (2 * mu0 / (mu0 + angles.cos_emission))
