"""`lunargr diagnose`: what the simulation gets wrong, why, and what fixing it is worth.

One likelihood, in six steps, each a folder:

model         The nominal simulation of every site, rendered again with small changes. Where its law does not fit, the mean of measured lunar
              laws takes its place, with the directions in which these differ. Ground that a wall beyond the DEM darkens is left out.
registration  Where the images lie. Shifts of up to 8 px are captured by correlation with the rendering, then explained: by nothing, a
              constant, an affine map or a smooth field per frame, with or without relief displacement. The simplest form that no other
              beats on held-out sites wins. Beside it lines of every image may be shifted against each other, as far as one half of
              their samples tells the other.
rows          Residuals relative to brightness, and what a little of everything would add to them, in windows on pieces of ground, as
              Fourier coefficients. Deep shadow counts, shadow edges do not: which ground is dark is judged by itself, last (``search/shadows.py``).
likelihood    The covariance of the residuals, estimated from them by wavelength: albedo and relief that all images of a place share,
              what each image has of its own, noise. One image of a place is enough, several tell the parts apart. Under it, generalised least squares
              for every effect, along with the nominal coefficients (which may drift from place to place, by as much as they are seen
              to), the directions in which the law may be another one, errors of the DEM, gains and shifts per frame, and ordinary amounts of other effects. Sham residuals, those of other ground
              mirrored and shuffled, say how large the largest of all statistics is when nothing is there.
search        The effect that gains most on held-out ground, if shams hardly do as well, is rendered at its values and everything is fitted
              again. It is named if it is real (its own file says what is plausible and what is ordinary), if it is there
              whichever images are left out, and if its held-out gain is above zero for sure. What is surely there and ordinary is rendered
              and not named. Then the next. Shadows and ground that images share are looked at by themselves, last.
structure     What is left that neither ground nor noise has, and nothing in the catalogue explains: lines, seams and patterns of the detector, single pixels
              (and effects that are in no catalogue, which the search finds).
result        What is named, how much of the residual is what, what was refused and why, what these data could not have shown.

Whatever is special about one effect stands in its own file under ``stages/effects``; the numbers set by hand that decide what is found stand in ``settings.py``.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from schemas.files.outputs import Output, Target
from schemas.later import without
from stages.common import runner
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.diagnose.config import Config

if TYPE_CHECKING:
    from stages.diagnose.stage import Finished, Result

__all__ = ["Config", "run"]


def _targets(call: runner.Call) -> list[Target]:
    named = ((call.output.path, "output"), (call.output.json, "json"), (call.output.report, "report"))
    return [Target(path, option) for path, option in named if path is not None]


def _check(call: runner.Call) -> None:
    """Refuse an unknown model before PyTorch is imported."""
    if call.arguments["checkpoint"] is None:
        with without("torch"):
            from stages.physics.photometry import get_model

            get_model(call.config.model)


@runner.stage(writes=_targets, check=_check, in_parts=True)
def run(
    pairs: Path,
    checkpoint: Path | None = None,
    output: Output | Path | None = None,
    config: Config = Config(),
    say: Say = say_nothing,
    progress: Progress = show_nothing,
) -> Result | Finished:
    """Diagnose the pairs; write what is asked for; of a run on another machine only the report comes back. Raises ArtefactError, ConfigError, RegistryError."""
    from stages.diagnose.stage import work

    return work(pairs, checkpoint, Output.at(output), config, say, progress)
