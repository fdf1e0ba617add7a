"""Write docs/photometry.md: formulas as implemented, parameters, sources, and how far from the outside tables they are.

    python examples/photometry_page.py --oracles FOLDER

Formulas come from the models' own module texts, so that the page cannot say what the code does not. FOLDER holds the
outside tables (default: $LUNARGR_SHARED/oracles, or 'shared/oracles' beside the repository).
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from itertools import groupby
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import photometry_oracles  # noqa: E402
from photometry_samples import reciprocity_error  # noqa: E402

from stages.physics import photometry  # noqa: E402
from stages.physics.photometry import catalogue, get_model, model_names  # noqa: E402

HEAD = """# Photometry

Written by `python examples/photometry_page.py`; edit the models' texts and run it again, never this page.

Every model returns the **radiance factor I/F = pi r**, with r the bidirectional reflectance in sr^-1. It includes
cos(i) and is normalised for the Sun's distance. The reflectance factor is I/F / cos(i), the BRDF is I/F / (pi cos(i));
`stages.physics.photometry.quantities` converts. i, e, g are incidence, emission and phase; mu0 = cos(i), mu = cos(e).
Angles are radians in the code; where a formula takes degrees, its unit says so.

    from stages.physics.photometry import evaluate, get_set
    evaluate("hapke", get_set("sato2014_643nm").values, incidence, emission, phase)   # numbers, arrays or tensors

I/F is exactly 0, with gradient 0, where Sun or camera is at or below the surface's horizon (cosine under 1e-12 in
float64, 1e-7 in float32). Everywhere else values and gradients are finite, at phase 0 too. Where a formula has a cusp
(Hapke's roughness at azimuth 0) the gradient returned is the mean of both sides.

`lunargr models` prints what follows, `lunargr convert` turns maps of coefficients into another program's convention.
"""


def formulas() -> list[str]:
    """The text of every module that defines a model, in the order of the registry."""
    lines = ["## Formulas as implemented", ""]
    modules = dict.fromkeys(type(get_model(name)).__module__ for name in model_names())
    extra = [f"{photometry.__name__}.roughness"]
    for module in [*modules, *extra]:
        text = (importlib.import_module(module).__doc__ or "").strip()
        names = [f"`{n}`" for n in model_names() if type(get_model(n)).__module__ == module]
        title = ", ".join(names) or "Macroscopic roughness"
        lines += [f"### {title}", "", f"`{module.replace('.', '/')}.py`", "", text, ""]
    return lines


def reciprocity() -> list[str]:
    """Declared and measured: the largest relative difference of the BRDF when Sun and camera change places."""
    lines = ["## Reciprocity", ""]
    lines += [
        "Largest |f(i,e) - f(e,i)| / (f(i,e) + f(e,i)) of the BRDF f over 2,000 random geometries and parameters.",
        "",
    ]
    lines += ["| model | declared | measured |", "|---|---|---|"]
    for name in model_names():
        error = reciprocity_error(name, np.random.default_rng(20261121))
        declared = "reciprocal" if get_model(name).reciprocal else "not reciprocal"
        lines.append(f"| `{name}` | {declared} | {'below 1e-12' if error < 1e-12 else f'{error:.1e}'} |")
    return [*lines, ""]


def agreement(folder: Path) -> list[str]:
    """Worst relative error of every model in every outside table."""
    lines = ["## Agreement with outside tables", ""]
    lines += [
        "Largest relative difference over all rows; tables with few printed digits count what lies within half of the"
    ]
    lines += ["last digit as equal. `tests/test_photometry_oracles.py` holds all of them to 1e-6.", ""]
    lines += ["| table | model | rows | largest relative difference |", "|---|---|---|---|"]
    wrong = []
    for table, compare in photometry_oracles.TABLES.items():
        comparisons = sorted(compare(folder), key=lambda c: c.model)
        wrong += [f"`{table}`, {c.wrong}." for c in comparisons if c.wrong]
        for model, group in groupby(comparisons, key=lambda c: c.model):
            members = list(group)
            worst = max(c.worst for c in members)
            printed = f" (to the {members[0].digits} digits printed)" if members[0].digits else ""
            shown = "0" if worst == 0 else f"{worst:.0e}"
            lines.append(f"| {table} | `{model}` | {sum(len(c.expected) for c in members)} | {shown}{printed} |")
    expected, as_isis, right_band = photometry_oracles.lrowacphomap(folder)
    for key in ("average", "standard_deviation", "minimum", "maximum"):
        difference = abs(as_isis[key] / expected[key] - 1)
        rows = int(expected["valid_pixels"])
        lines.append(f"| isis_lrowacphomap_pixels.csv, {key.replace('_', ' ')} | `hapke` | {rows} | {difference:.0e} |")
    lines += ["", "Where a table is not to be met:", ""]
    lines += [f"- {text}" for text in wrong]
    lines += [
        "- `isis_photometry_truth.csv`: 9 rows with an atmosphere are left out.",
        f"- `isis_lrowacphomap_expected.json`: ISIS divides by the map's 689 nm and multiplies by its 321 nm for an image"
        f" at 415 nm. Run in that way the statistics agree as above; with the right band the average is"
        f" {right_band['average']:.2f} and not {expected['average']:.2f}.",
        "- `isis_hillshade_truth.csv`: ISIS divides the height difference of rows two apart by one pixel, so that its"
        " slopes are twice the true ones; the tests meet its values at half its pixel size.",
        "- `giant_illumination_dense_grid.csv`: the Ashikhmin-Shirley rows belong to `examples/new_reflectance_model.py`,"
        " which meets them; the derivatives to slope and albedo of the other four agree with autograd to 2e-6.",
    ]
    return [*lines, ""]


def page(folder: Path) -> str:
    parts = [HEAD, catalogue.markdown(), "", *formulas(), *reciprocity(), *agreement(folder)]
    return "\n".join(parts).rstrip() + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    shared = Path(os.environ.get("LUNARGR_SHARED", ROOT.parent / "shared"))
    parser.add_argument("--oracles", type=Path, default=shared / "oracles")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "photometry.md")
    options = parser.parse_args()
    if not options.oracles.is_dir():
        sys.exit(f"{options.oracles}: no such folder; give the outside tables with --oracles.")
    options.output.parent.mkdir(exist_ok=True)
    options.output.write_text(page(options.oracles))
    print(options.output)


if __name__ == "__main__":
    main()
