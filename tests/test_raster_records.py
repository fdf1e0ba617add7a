"""GeoTIFF and EXR say who made them and from what, as HDF5 artefacts do; every command writes GeoTIFF alike."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest
import rasterio
from command import outcome as lunargr

from schemas.provenance import chain, sha256
from stages import convert, render
from stages.physics.maps.geotiff import write_geotiff
from stages.physics.maps.grid import Grid, local_metric_crs, read_grid


@pytest.fixture
def rendered(hilly_map):
    """The map, and what ``lunargr render`` made of it in its folder."""
    path = hilly_map[0]
    code, said = lunargr("render", path, "--sun-azimuth", 90, "--sun-elevation", 30, "-o", path.with_name("view.exr"))
    assert code == 0, said
    return path


@pytest.mark.parametrize("name", ["view.exr", "view.tif"])
def test_inspect_and_replay_read_rasters_as_they_read_artefacts(rendered, name):
    picture = rendered.with_name(name)
    source, last = chain(picture)
    assert source.name == "svbrdf.h5" and source.sha256 == sha256(rendered)
    assert source.record["schema"] == "svbrdf"
    assert last.record["command"].startswith("lunargr render ") and last.record["config"]["sun_azimuth_deg"] == 90
    code, said = lunargr("inspect", picture, "--json", picture.with_suffix(".json"))
    assert code == 0 and "lunargr render" in said and sha256(rendered)[:12] in said and "image" in said
    told = json.loads(picture.with_suffix(".json").read_text())
    assert told["bands"]["image"]["shape"] == [160, 200] and told["chain"][-1]["record"] == last.record
    code, script = lunargr("replay", picture)
    assert code == 0 and script.splitlines()[-1].endswith(f"|| {last.record['command']}")


@pytest.mark.parametrize(("command", "kind"), [("replay", "foreign"), ("replay", "damaged"), ("inspect", "damaged")])
def test_a_raster_of_another_program_is_one_line(tmp_path, command, kind):
    path = tmp_path / "other.tif"
    with rasterio.open(path, "w", driver="GTiff", width=4, height=4, count=1, dtype="uint8",
                       crs="EPSG:4326", transform=rasterio.Affine(2, 0, 5, 0, -2, 9)) as file:  # fmt: skip
        file.write(np.ones((1, 4, 4), np.uint8))
    if kind == "damaged":
        path.write_bytes(path.read_bytes()[:12])
    code, said = lunargr(command, path)
    assert code == 3 and len(said.splitlines()) == 1 and "other.tif" in said


def test_every_command_writes_one_kind_of_geotiff_with_named_bands_units_and_crs(rendered):
    folder = rendered.parent
    with h5py.File(rendered) as file:
        write_geotiff(folder / "map.tif", file, read_grid(file, rendered))
    convert.run(folder / "map.tif", folder / "paper.tif", convert.Config("lunargr:M2", "g2r:polynomial_3p_cst"))
    render.run(
        rendered, folder / "b.tif", render.Config(sun_azimuth_deg=90, sun_elevation_deg=30, backplanes_in_tif=True)
    )
    profiles = []
    for name in ("map.tif", "paper.tif", "view.tif", "b.tif"):
        with rasterio.open(folder / name) as file:
            profiles.append(
                {k: file.profile[k] for k in ("dtype", "blockxsize", "compress", "crs", "transform")}
                | {"layout": file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"], "nodata": str(file.nodata)}
            )
            assert file.count == 1 or file.profile["interleave"] == "pixel"
            assert all(file.descriptions) and all(file.units), name
            assert file.tags()["software"] == "lunargr"
            assert "local stereographic" in file.crs.to_wkt() and "unknown" not in file.crs.to_wkt()
        assert chain(folder / name)[-1].record is not None
    assert profiles == [profiles[0]] * 4


def test_a_name_does_not_move_the_grid():
    crs = local_metric_crs(-30.0, -45.0, 3389500.0)
    assert 'PROJCS["Mars local stereographic at 45.000 S -30.000 E"' in crs.to_wkt()
    plain = rasterio.crs.CRS.from_proj4("+proj=stere +lat_0=-45 +lon_0=-30 +k=1 +R=3389500 +units=m +no_defs")
    transform = rasterio.Affine(100, 0, -5000, 0, -100, 7000)
    named, unnamed = (Grid(c.to_wkt(), transform, 100, 100, 3389500.0).lonlat([0, 99], [3, 50]) for c in (crs, plain))
    np.testing.assert_array_equal(named, unnamed)
