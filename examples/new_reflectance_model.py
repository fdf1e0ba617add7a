"""A new reflectance model in one file: the diffuse part of Ashikhmin and Shirley's BRDF.

Save a file like this one in stages/physics/photometry/ and everything follows from it: the network's output channels,
`lunargr train --model ashikhmin_shirley`, `lunargr models`, the docs' tables and the parametrised tests of gradients,
finiteness, reciprocity and precision. Run as it is, it shows itself:

    python examples/new_reflectance_model.py
"""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import Parameter, ReflectanceModel, register


@register  # from here on the model is known by its name
class AshikhminShirley(ReflectanceModel):
    name = "ashikhmin_shirley"
    title = "Ashikhmin-Shirley, diffuse part"
    formula = "28/23 A cos(i) [1 - (1 - cos(i)/2)^5] [1 - (1 - cos(e)/2)^5]"
    reference = "Ashikhmin, M. and Shirley, P. (2000), J. Graphics Tools 5, 25"
    reciprocal = True  # measured by the tests, so a wrong claim fails
    linear = True  # in its parameters: a global fit is one least-squares solve
    finite = True  # no division, no root: any cosines will do
    parameters = (Parameter("albedo", "1", 0.0, 1.0, 0.12, "diffuse albedo"),)
    # the same for the page of `lunargr view`, which refuses a model without it
    glsl = """
float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g) {
  return 28.0 / 23.0 * p[0] * mu0 * (1.0 - pow(1.0 - mu0 / 2.0, 5.0)) * (1.0 - pow(1.0 - mu / 2.0, 5.0));
}
"""

    def radiance_factor(self, parameters: Mapping[str, Tensor], angles: Angles) -> Tensor:
        """I/F = pi r, so with cos(incidence) in it; parameters broadcast with the angles."""
        mu0, mu = angles.cos_incidence, angles.cos_emission
        lobes = (1 - (1 - mu0 / 2) ** 5) * (1 - (1 - mu / 2) ** 5)
        return (28 / 23) * parameters["albedo"] * mu0 * lobes


def main() -> None:
    import numpy as np
    import torch

    from stages.physics.photometry import evaluate, get_model

    model = get_model("ashikhmin_shirley")
    print(f"{model.title}: I/F = {model.formula}\nsource: {model.reference}\n")
    print("incidence     I/F   (seen from above, albedo 0.12)")
    for degrees in range(0, 91, 15):
        i = np.radians(degrees)
        print(f"{degrees:6d} deg {evaluate(model.name, {}, i, 0.0, i):9.5f}")
    albedo = torch.tensor(0.12, dtype=torch.float64, requires_grad=True)
    image = evaluate(model.name, {"albedo": albedo}, torch.tensor(0.5, dtype=torch.float64), 0.1, 0.4)
    (slope,) = torch.autograd.grad(image, albedo)
    print(f"\nd(I/F) / d(albedo) at incidence 0.5 rad: {slope.item():.5f}")


if __name__ == "__main__":
    main()
