# %% [markdown]
# # From pairs to a relit map
# This notebook opens `pairs.h5` with xarray, trains a network on it, relights its map with numpy, and compares the result with
# `lunargr render`. The files are those of `make demo-full`. It is `examples/relight.py`, run cell by cell by `examples/notebook_page.py`.
# It needs xarray and h5netcdf.

# %%
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import rasterio
import xarray as xr

from stages.physics.horizon import cast_shadow
from stages.physics.photometry import evaluate, get_model


def lunargr(*words):
    """A command, as in a terminal; in a notebook `!lunargr ...` does the same."""
    subprocess.run([sys.executable, "-m", "lunargr_cli.main", *map(str, words), "--quiet"], check=True)


# %% [markdown]
# ## What a pair is
# A crop of terrain, an image of it, and the directions of Sun and camera. Every variable has its unit as an attribute.

# %%
pairs = xr.open_dataset("pairs.h5", engine="h5netcdf")
print(pairs[["elevation", "image", "sun_horizon_deg"]])

# %%
pair = pairs.isel(pair=0)
east, north, up = pair.sun_direction_enu.values
azimuth, elevation = np.degrees([np.arctan2(east, north), np.arcsin(up)])
figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained")
shown = (
    (pair.elevation, "elevation, m", {"cmap": "cividis"}),
    (
        pair.image.where(pair.valid == 1),
        "image, I/F" if pair.image.units == "1" else "image, DN",
        {"cmap": "gray", "vmin": 0, "robust": True},
    ),
    (pair.sun_horizon_deg, "horizon towards the Sun, deg", {"cmap": "magma"}),
)
for axis, (data, title, style) in zip(axes, shown, strict=True):
    data.plot.imshow(ax=axis, origin="upper", cbar_kwargs={"label": "", "shrink": 0.8}, **style)
    axis.set(title=title, xlabel="", ylabel="", aspect="equal")
print(f"the Sun stands {elevation:.1f} deg high, {azimuth % 360:.1f} deg clockwise from north")

# %% [markdown]
# ## Learn the reflectance, map it
# Two passes over the pairs give a first map; `make demo-full` takes six, from three seeds.

# %%
if not Path("relight_map.h5").exists():
    lunargr("train", "pairs.h5", "--epochs", 2, "--precision", "fp32", "-o", "relight_checkpoint.h5", "--overwrite")
    lunargr("infer", "scene.h5", "relight_checkpoint.h5", "-o", "relight_map.h5", "--overwrite")
maps = xr.open_dataset("relight_map.h5", engine="h5netcdf")
model = get_model(maps.attrs["model"])
print(f"{model.name}: I/F = {model.formula}")
print("coefficients:", ", ".join(maps.coefficient.values))

# %% [markdown]
# A coefficient is selected by its name. Coefficients that the network predicts per pixel have a standard deviation.

# %%
name = str(maps.map_name.values[0])
figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
means = {p.name: p.description for p in model.parameters}
bar = {"label": "", "shrink": 0.8}
maps.coefficients.sel(coefficient=name).plot.imshow(ax=axes[0], robust=True, cbar_kwargs=bar)
maps.coefficients_std.sel(map=name).plot.imshow(ax=axes[1], robust=True, cmap="magma", cbar_kwargs=bar)
for axis, title in zip(axes, (f"{name}, {means[name]}", "its standard deviation"), strict=True):
    axis.set(title=title, xlabel="grid easting, m", ylabel="grid northing, m", aspect="equal")

# %% [markdown]
# ## Another Sun
# Normals come from central differences of the heights; the camera is straight above, so the emission angle is the slope and the phase
# angle the Sun's distance from the zenith. I/F includes cos(incidence); where terrain hides the Sun it is 0.


# %%
def relight(maps, azimuth_deg, elevation_deg):
    """I/F of a map under a Sun at this azimuth (clockwise from north) and elevation, as a DataArray."""
    gsd = float(maps.attrs["gsd_m"])
    heights = maps.elevation.values.astype(float)
    down, across = np.gradient(heights, gsd)  # rows run south
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    sun = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    normal = np.stack([-across, down, np.ones_like(heights)]) / np.sqrt(1 + across**2 + down**2)
    incidence = np.arccos(np.clip(np.tensordot(sun, normal, 1), -1, 1))
    coefficients = {str(n): maps.coefficients.sel(coefficient=n).values.astype(float) for n in maps.coefficient.values}
    iof = evaluate(maps.attrs["model"], coefficients, incidence, np.arccos(normal[2]), np.pi / 2 - elevation)
    known = np.isfinite(incidence)  # not beside holes, where there is no slope
    ground = np.where(np.isfinite(heights), heights, np.nanmin(heights)).astype(np.float32)
    shadow = cast_shadow(ground, gsd, azimuth, elevation) | (incidence > np.pi / 2)
    iof = np.where(known, np.where(shadow, 0.0, np.maximum(iof, 0.0)), np.nan)
    return maps.elevation.copy(data=iof).rename("I/F").assign_attrs(units="1", long_name="I/F")


suns = [(270, 25), (90, 25), (180, 60)]
figure, axes = plt.subplots(1, 3, figsize=(12, 4), layout="constrained")
for axis, (azimuth, elevation) in zip(axes, suns, strict=True):
    lit = relight(maps, azimuth, elevation)
    lit.plot.imshow(ax=axis, cmap="gray", vmin=0, vmax=0.1, add_colorbar=False)
    axis.set(
        title=f"azimuth {azimuth}, {elevation} deg high", xlabel="", ylabel="", xticks=[], yticks=[], aspect="equal"
    )

# %% [markdown]
# ## The same by the command
# `lunargr render` knows more: the Sun is a disc, its direction changes over the map, pixels have their true size.

# %%
lunargr("render", "relight_map.h5", "--sun-azimuth", 270, "--sun-elevation", 25, "-o", "relight.tif", "--overwrite")
with rasterio.open("relight.tif") as file:
    theirs = file.read(1)
ours = relight(maps, 270, 25).values
ratio = np.nanmean(ours) / np.nanmean(theirs)
correlation = np.corrcoef(*(v[np.isfinite(ours) & np.isfinite(theirs)] for v in (ours, theirs)))[0, 1]
print(f"mean I/F here over that of the command: {ratio:.4f}; correlation {correlation:.4f}")
