"""Write docs/photometry.md: formulas, parameters and sources; and the agreement with outside tables in docs/validation.md.

    python examples/photometry_page.py --oracles FOLDER

Formulas come from the module texts of the models. FOLDER holds the outside tables (default: $LUNARGR_SHARED/oracles, or
'shared/oracles' beside the repository); without them docs/validation.md stays as it is.
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests/support")]

import photometry_oracles  # noqa: E402
from photometry_samples import reciprocity_error  # noqa: E402

from stages.physics import photometry  # noqa: E402
from stages.physics.photometry import catalogue, get_model, model_names  # noqa: E402

BLOCK = re.compile(r"(<!-- photometry: begin -->\n).*?(<!-- photometry: end -->)", re.S)
HEAD = """# Formulas of the reflectance models

`python examples/photometry_page.py` writes this page from the texts of the models. `lunargr models NAME` prints the entry of one model.
Which one to take: [Which model, which maps](models.md).

Every model gives the **radiance factor I/F = pi r**, with r the bidirectional reflectance in 1/sr. It includes cos(i) and is normalised for
the Sun's distance. i, e, g are incidence, emission and phase; mu0 = cos(i), mu = cos(e). Angles are in radians unless a unit says otherwise.

    from stages.physics.photometry import evaluate, get_set
    evaluate("hapke", get_set("sato2014_643nm").values, incidence, emission, phase)   # numbers, arrays or tensors

I/F is 0, with gradient 0, where Sun or camera is at or below the surface's horizon. Elsewhere values and gradients are finite, at phase 0 too.
"""


def formulas() -> list[str]:
    """The text of every module that defines a model, in the order of the registry."""
    lines = ["## Formulas", ""]
    modules = dict.fromkeys(type(get_model(name)).__module__ for name in model_names())
    extra = [f"{photometry.__name__}.roughness"]
    for module in [*modules, *extra]:
        text = (importlib.import_module(module).__doc__ or "").strip()
        names = [f"`{n}`" for n in model_names() if type(get_model(n)).__module__ == module]
        title = ", ".join(names) or "Macroscopic roughness"
        lines += [f"### {title}", "", text, ""]
    return lines


def reciprocity() -> list[str]:
    """Which models are reciprocal: the BRDF when Sun and camera change places."""
    worst = {name: reciprocity_error(name, np.random.default_rng(20261121)) for name in model_names()}
    same = [f"`{n}`" for n, error in worst.items() if error < 1e-12]
    other = [f"`{n}`" for n, error in worst.items() if error >= 1e-12]
    return [
        f"Over 2,000 random geometries the BRDF is reciprocal to 1e-12 for {', '.join(same)}. Not reciprocal, as declared: {', '.join(other)}.",
        "",
    ]


def agreement(folder: Path) -> list[str]:
    """Worst relative error in every outside table."""
    lines = ["| table | models | rows | largest relative difference |", "|---|---|---|---|"]
    wrong = []
    for table, compare in photometry_oracles.TABLES.items():
        comparisons = sorted(compare(folder), key=lambda c: c.model)
        wrong += [f"`{table}`, {c.wrong}." for c in comparisons if c.wrong]
        names = ", ".join(f"`{n}`" for n in dict.fromkeys(c.model for c in comparisons))
        worst, digits = max(c.worst for c in comparisons), comparisons[0].digits
        shown = f"0 to the {digits} digits printed" if digits and worst == 0 else f"{worst:.0e}"
        lines.append(f"| {table} | {names} | {sum(len(c.expected) for c in comparisons):,} | {shown} |")
    expected, as_isis, right_band = photometry_oracles.lrowacphomap(folder)
    worst = max(
        abs(as_isis[key] / expected[key] - 1) for key in ("average", "standard_deviation", "minimum", "maximum")
    )
    lines.append(
        f"| isis_lrowacphomap_pixels.csv, statistics | `hapke` | {int(expected['valid_pixels']):,} | {worst:.0e} |"
    )
    lines += [
        "",
        "Rows that the models do not reproduce, because the table is wrong there or covers something else:",
        "",
    ]
    lines += [f"- {text}" for text in wrong]
    lines += [
        "- `isis_photometry_truth.csv`: 9 rows with an atmosphere are left out.",
        "- `isis_lrowacphomap_expected.json`: ISIS divides by the map's 689 nm and multiplies by its 321 nm for an image at 415 nm. Done the same"
        f" way the statistics agree; with the right band the average is {right_band['average']:.2f} instead of {expected['average']:.2f}.",
        "- `isis_hillshade_truth.csv`: ISIS divides the height difference of rows two apart by one pixel, so its slopes are twice the true ones."
        " The tests reproduce its values at half its pixel size.",
        "- `giant_illumination_dense_grid.csv`: the Ashikhmin-Shirley rows belong to `examples/new_reflectance_model.py`, which reproduces them.",
    ]
    return [*lines, ""]


def page() -> str:
    return "\n".join([HEAD, catalogue.markdown(), "", *formulas()]).rstrip() + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    shared = Path(os.environ.get("LUNARGR_SHARED", ROOT.parent / "shared"))
    parser.add_argument("--oracles", type=Path, default=shared / "oracles")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs")
    options = parser.parse_args()
    (options.docs / "photometry.md").write_text(page())
    print(options.docs / "photometry.md")
    if not options.oracles.is_dir():
        print(f"docs/validation.md stays as it is: no outside tables at {options.oracles}")
        return
    validation = options.docs / "validation.md"
    block = "\n".join([*agreement(options.oracles), *reciprocity()])
    validation.write_text(BLOCK.sub(lambda found: f"{found[1]}\n{block}\n{found[2]}", validation.read_text()))
    print(validation)


if __name__ == "__main__":
    main()
