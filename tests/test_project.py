"""project: images on the crops' grid, Sun and camera in the crops' frames, the horizon of the whole DEM."""

from __future__ import annotations

import csv

import h5py
import numpy as np
import pytest
import rasterio
import small_scene
import torch
from rasterio.transform import Affine

from schemas import ArtefactError, GeometryError, InputError
from schemas.packing import read
from stages import ingest, project, sample
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import form
from stages.physics.maps.grid import Grid
from stages.physics.photometry import get_model


def local(file, k):
    """Metres east and north of the scene's centre of the crop's pixel centres."""
    size = file["elevation"].shape[1]
    half = small_scene.SIZE * small_scene.GSD / 2
    col = file["col"][k] - size // 2 + np.arange(size) + 0.5
    row = file["row"][k] - size // 2 + np.arange(size) + 0.5
    return np.meshgrid(col * small_scene.GSD - half, half - row * small_scene.GSD)


def test_images_are_area_means_of_the_truth_to_the_pixel(small_artefacts, tmp_path):
    """Against the closed form: the area mean of I/F by 5 x 5 points per pixel. A shift of 0.05 px would show."""
    offsets = (np.arange(5) - 2) / 5 * small_scene.GSD
    residual, shifted = [], []
    project.run(small_artefacts["crops"], tmp_path / "exact.h5", project.Config(exact=True))
    with h5py.File(tmp_path / "exact.h5") as file:
        for k in range(0, file["row"].shape[0], 5):
            x, y = local(file, k)
            expected = np.mean([small_scene.radiance_factor(x + a, y + b) for a in offsets for b in offsets], axis=0)
            moved = small_scene.radiance_factor(x + 0.1 * small_scene.GSD, y)
            residual.append(file["image"][k] - expected)
            shifted.append(file["image"][k] - moved)
            assert file["valid"][k].all()
    assert np.abs(residual).max() < 4e-4
    assert np.sqrt(np.mean(np.square(residual))) < 0.5 * np.sqrt(np.mean(np.square(shifted)))


def test_sun_and_camera_follow_spherical_trigonometry(small_artefacts):
    with h5py.File(small_artefacts["pairs"]) as file:
        lon, lat = file["longitude_deg"][...], file["latitude_deg"][...]
        sun, camera = file["sun_direction_enu"][...], file["camera_position_enu"][...]
        turn = np.radians(file["convergence_deg"][...])
        # grid axes: true north lies `turn` clockwise from grid north
        east = sun[:, 0] * np.cos(turn) - sun[:, 1] * np.sin(turn)
        north = sun[:, 0] * np.sin(turn) + sun[:, 1] * np.cos(turn)
        expected = small_scene.sun_enu(lon, lat)
        # The Sun is 1 au away, not at infinity: its parallax on the Moon is 1.2e-5 rad.
        np.testing.assert_allclose(np.stack([east, north, sun[:, 2]], 1), expected, atol=2.5e-5)
        np.testing.assert_allclose(np.linalg.norm(sun, axis=1), 1, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(camera, axis=1), 5e7, rtol=1e-3)
        assert np.abs(file["convergence_deg"][...]).max() < 0.1


@pytest.mark.parametrize("longitude", [0.0, 30.0, 135.0, 250.0])
def test_convergence_on_a_polar_map_is_the_longitude(longitude):
    """South polar stereographic, central meridian 0: true north at longitude L points outwards, L clockwise from map-up."""
    from rasterio.crs import CRS

    crs = CRS.from_proj4("+proj=stere +lat_0=-90 +lon_0=0 +k=1 +R=1737400 +units=m +no_defs")
    grid = Grid(crs.to_wkt(), Affine(100, 0, -200000, 0, -100, 200000), 4000, 4000, 1737400.0)
    row, col = grid.rowcol_of_lonlat(longitude, -88.0)
    frame = grid.local_frames(row, col)
    assert np.cos(np.radians(frame.convergence_deg[0] - longitude)) == pytest.approx(1, abs=1e-9)
    # Polar stereographic scale k = 2 / (1 + sin|lat|): a 100 m pixel is 100 / k true metres.
    scale = 2 / (1 + np.sin(np.radians(88)))
    np.testing.assert_allclose(frame.pixel_size, 100 / scale, rtol=1e-6)


def test_terrain_outside_the_crop_casts_its_shadow(tmp_path):
    """A wall far outside the crop, towards the Sun: its horizon is atan((height - drop) / distance)."""
    wall = np.zeros((256, 256), np.float32)
    wall[:, 8:12] = 900.0
    small_scene.write_raster(tmp_path / "dem.tif", wall, small_scene.local_crs(), Affine(20, 0, -2560, 0, -20, 2560))
    files = small_scene.write_scene(tmp_path / "files", images=1, nodata_hole=False)
    ingest.run(tmp_path / "dem.tif", files.images, tmp_path / "scene.h5", ingest.Config(crop=32))
    sample.run(tmp_path / "scene.h5", tmp_path / "crops.h5", sample.Config(count=20, tile_m=1000, crop=32))
    project.run(tmp_path / "crops.h5", tmp_path / "pairs.h5", project.Config())
    checked = 0
    with h5py.File(tmp_path / "pairs.h5") as file:
        for k in range(file["row"].shape[0]):
            col = file["col"][k] - 16 + np.arange(32)
            if col[0] < 24:
                continue
            sun = file["sun_direction_enu"][k]
            distance = (col - 11) * 20 / abs(sun[0] / np.hypot(sun[0], sun[1]))
            expected = np.degrees(np.arctan((900 - distance**2 / (2 * small_scene.RADIUS)) / distance))
            middle = read(file["sun_horizon_deg"], k)[8:24]  # rows far from where the wall ends
            if np.abs(file["row"][k] - 128) < 60:
                np.testing.assert_allclose(middle, np.broadcast_to(expected, middle.shape), atol=0.35)
                checked += 1
    assert checked > 0


def test_unknown_pixels_do_not_spoil_the_rounded_ones(small_artefacts, tmp_path, monkeypatch):
    """Where an image ends inside a crop, from its first pixel on: the rest must come back, and what is unknown as NaN."""
    from stages.physics.images.source_images import MapSource, Pixels

    whole = MapSource.read

    def cut_off(self, *window):
        pixels = whole(self, *window)
        pixels.values[:3], pixels.valid[:3] = np.nan, False
        return Pixels(pixels.values, pixels.valid, None)

    monkeypatch.setattr(MapSource, "read", cut_off)
    project.run(small_artefacts["crops"], tmp_path / "cut.h5", project.Config())
    with PairReader(tmp_path / "cut.h5") as cut, PairReader(small_artefacts["pairs"]) as full:
        found, expected = cut.batch([0, 5]), full.batch([0, 5])
    assert not found.valid[:, :3].any() and found.valid[:, 3:].all()
    assert torch.equal(found.image[:, 3:], expected.image[:, 3:])


def test_moved_scene_changed_scene_and_mixed_units(small_artefacts, small_files, tmp_path):
    with pytest.raises(ArtefactError, match="`scene`"):
        elsewhere = tmp_path / "crops.h5"
        elsewhere.write_bytes(small_artefacts["crops"].read_bytes())
        project.run(elsewhere, tmp_path / "p.h5", project.Config())
    ingest.run(small_files.dem, small_files.images, tmp_path / "scene.h5", ingest.Config(gsd=40, crop=32))
    with pytest.raises(ArtefactError, match="not the scene"):
        project.run(small_artefacts["crops"], tmp_path / "p.h5", project.Config(scene=str(tmp_path / "scene.h5")))
    mixed = small_scene.write_scene(tmp_path / "mixed", gain=[(1000, 5)] * 3)
    table = mixed.images.read_text().replace("IMG0,image0.tif,dn", "IMG0,image0.tif,iof")
    mixed.images.write_text(table)
    ingest.run(mixed.dem, mixed.images, tmp_path / "m.h5", ingest.Config(crop=32))
    sample.run(tmp_path / "m.h5", tmp_path / "mc.h5", sample.Config(count=30, tile_m=1280))
    with pytest.raises(InputError, match="both 'iof' and 'dn'"):
        project.run(tmp_path / "mc.h5", tmp_path / "p.h5", project.Config())
    assert not (tmp_path / "p.h5").exists()


def test_sun_below_a_crops_horizon_is_refused(tmp_path):
    files = small_scene.write_scene(tmp_path / "f", images=1)
    text = files.images.read_text().replace(",-25.0,", ",-70.18,")  # the terminator runs through the scene
    files.images.write_text(text)
    with pytest.raises(GeometryError, match="horizon"):
        ingest.run(files.dem, files.images, tmp_path / "s.h5", ingest.Config(crop=32))
        sample.run(tmp_path / "s.h5", tmp_path / "c.h5", sample.Config(count=50, tile_m=1280))
        project.run(tmp_path / "c.h5", tmp_path / "p.h5", project.Config())


def test_what_packing_drops_does_not_matter(small_artefacts, tmp_path):
    """Against float32: half a step at most, masks alike, and renderings that differ far less than noise at SNR 200."""
    project.run(small_artefacts["crops"], tmp_path / "exact.h5", project.Config(exact=True))
    with h5py.File(tmp_path / "exact.h5") as exact, h5py.File(small_artefacts["pairs"]) as kept:
        np.testing.assert_array_equal(exact["valid"][...], kept["valid"][...])
        for name, step in (("elevation", 20 / 512), ("image", 3.15e-5), ("sun_horizon_deg", 2**-8)):
            assert exact[name].dtype == np.float32 and kept[name].dtype == np.int16
            assert kept[name].chunks == (1, 32, 32) and kept[name].attrs["scale_factor"] <= step, name
            difference = np.abs(exact[name][...].astype(float) - read(kept[name], ...))[exact["valid"][...] == 1]
            assert 0 < difference.max() <= 0.501 * kept[name].attrs["scale_factor"], name
    model = get_model("M2")
    uniform = torch.tensor([small_scene.A, small_scene.B, small_scene.C]).view(1, -1, 1, 1)
    images = []
    for path in (tmp_path / "exact.h5", small_artefacts["pairs"]):
        with PairReader(path) as reader:
            batch = reader.batch(np.arange(40))
            images.append(form(batch.observation, model, uniform) * batch.valid)
    noise = images[0][images[0] > 0].mean() / 200
    assert (images[0] - images[1]).square().mean().sqrt() < 0.1 * noise


def test_heights_of_a_high_scene_count_from_each_pairs_reference(small_files, tmp_path):
    """A slope of 1500 m: 16 bits hold a crop in fine steps, not the scene. Expected: the DEM's own heights."""
    with rasterio.open(small_files.dem) as source:
        z, nodata = source.read(1), source.nodata
        z = np.where(z == nodata, nodata, z + np.linspace(0, 1500, z.shape[1])).astype(np.float32)
        small_scene.write_raster(tmp_path / "dem.tif", z, source.crs, source.transform, nodata=nodata)
    ingest.run(tmp_path / "dem.tif", small_files.images, tmp_path / "scene.h5", ingest.Config(crop=32))
    sample.run(tmp_path / "scene.h5", tmp_path / "crops.h5", sample.Config(count=40, tile_m=1280, crop=32))
    project.run(tmp_path / "crops.h5", tmp_path / "pairs.h5", project.Config())
    with h5py.File(tmp_path / "pairs.h5") as file, PairReader(tmp_path / "pairs.h5") as reader:
        step = float(file["elevation"].attrs["scale_factor"])
        found = reader.elevation(np.arange(reader.count)).numpy()
        assert step < 0.1 and file["reference_elevation"][...].max() > 1000
        for k, (row, col) in enumerate(zip(file["row"][...], file["col"][...], strict=True)):
            np.testing.assert_allclose(found[k], z[row - 16 : row + 16, col - 16 : col + 16], atol=0.51 * step)


def test_xarray_decodes_packed_pairs(small_artefacts, tmp_path):
    """Its default decoding of CF gives the values and units of the file that keeps all digits."""
    xarray = pytest.importorskip("xarray")
    project.run(small_artefacts["crops"], tmp_path / "exact.h5", project.Config(exact=True))
    with (
        xarray.open_dataset(small_artefacts["pairs"], engine="h5netcdf") as data,
        xarray.open_dataset(tmp_path / "exact.h5", engine="h5netcdf") as exact,
        PairReader(small_artefacts["pairs"]) as reader,
    ):
        for name, unit, step in (
            ("elevation", "m", 20 / 512),
            ("image", "1", 3.15e-5),
            ("sun_horizon_deg", "degree", 2**-8),
        ):
            assert data[name].attrs["units"] == unit and data[name].dtype.kind == "f"
            np.testing.assert_allclose(data[name], exact[name], rtol=0, atol=0.501 * step)
        height = data["elevation"] + data["reference_elevation"]
        np.testing.assert_array_equal(height.values, reader.known_elevation(np.arange(reader.count)))


def test_every_crop_has_the_sun_and_the_camera_of_its_own_image(tmp_path):
    """Three images under three Suns from three places; the horizon is looked for towards each crop's own Sun."""
    files = small_scene.write_scene(tmp_path / "files")
    with open(files.images, newline="") as stream:
        table = list(csv.DictReader(stream))
    suns = [(-25.0, 1.0), (60.0, -1.0), (0.0, 40.0)]
    for row, (longitude, latitude), altitude in zip(table, suns, (5e7, 6e7, 7e7), strict=True):
        row |= {"subsolar_longitude_deg": longitude, "subsolar_latitude_deg": latitude}
        row |= {"spacecraft_altitude_m": altitude}
    with open(files.images, "w", newline="") as stream:
        writer = csv.DictWriter(stream, table[0].keys())
        writer.writeheader()
        writer.writerows(table)
    ingest.run(files.dem, files.images, tmp_path / "scene.h5", ingest.Config(gsd=20, crop=32))
    sample.run(tmp_path / "scene.h5", tmp_path / "crops.h5", sample.Config(count=24, tile_m=1280))
    project.run(tmp_path / "crops.h5", tmp_path / "pairs.h5", project.Config())
    with h5py.File(tmp_path / "pairs.h5") as file:
        index = file["image_index"][...]
        lon, lat, sun = (file[n][...] for n in ("longitude_deg", "latitude_deg", "sun_direction_enu"))
        distance = np.linalg.norm(file["camera_position_enu"][...], axis=1)
    assert set(index) == {0, 1, 2}
    for k, subsolar in enumerate(suns):
        mine = index == k
        # grid north is true north to 0.1 deg here
        np.testing.assert_allclose(sun[mine], small_scene.sun_enu(lon[mine], lat[mine], subsolar), atol=2e-3)
        np.testing.assert_allclose(distance[mine], (5e7, 6e7, 7e7)[k], rtol=1e-3)
