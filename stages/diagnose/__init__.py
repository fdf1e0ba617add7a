"""`lunargr diagnose`: what the simulation gets wrong, why, and what fixing it is worth.

Sources of evidence claim, one function decides; ``stage.py`` tells it in order.

data          Measured pairs by the ground that they show, laid over it.
model         The nominal simulation of every site, rendered again with small changes. The directions in which measured lunar laws differ from it are
              open, and fitted.
registration  Where the images lie. Shifts of up to 8 px are captured by correlation with the rendering, then explained by a form that
              predicts other sites best. Lines of an image may be shifted against each other.
likelihood    Residuals relative to brightness as Fourier coefficients of windows, what a little of everything would add to them, their
              covariance, and under it generalised least squares for every effect, beside all that is fitted along. Sham residuals say how
              large the largest of all statistics is when nothing is there.
sources       Claims: of the search over templates, of registration, shadows, the ground, frames and clipping.
judge         A claim, its rivals, and ``decide``; the fit of all causes together; what is blind, by injection.
faults        What is left varies between the cells of a partition of the detector by more than chance.
result        The answer, its files and page, the gain on test pairs.

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
