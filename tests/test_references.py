"""What a file may refer to: neither system files nor devices, nor the network, nor itself."""

from __future__ import annotations

import http.server
import os
import shutil
import threading

import h5py
import numpy as np
import pytest
from rasterio.transform import Affine
from small_scene import local_crs, write_raster
from test_schemas import write_pairs

from schemas import PAIRS, ArtefactError, InputError, open_artefact
from schemas.files.inputs import files_named_in
from schemas.files.references import is_inside
from schemas.provenance import chain
from stages.physics.maps import rasters

BAND = '<VRTRasterBand dataType="Float32" band="1">{}</VRTRasterBand>'
SOURCE = '<SimpleSource><SourceFilename relativeToVRT="{}">{}</SourceFilename><SourceBand>1</SourceBand></SimpleSource>'
RAW = (
    '<VRTRasterBand dataType="Byte" band="1" subClass="VRTRawRasterBand"><SourceFilename>/etc/passwd</SourceFilename>'
    "<ImageOffset>0</ImageOffset><PixelOffset>1</PixelOffset><LineOffset>4</LineOffset></VRTRasterBand>"
)


def write_vrt(path, inside):
    path.write_text(f'<VRTDataset rasterXSize="4" rasterYSize="4">{inside}</VRTDataset>')
    return path


@pytest.fixture
def raster(tmp_path):
    values = np.arange(16, dtype=np.float32).reshape(4, 4)
    return write_raster(tmp_path / "dem.tif", values, local_crs(), Affine(20, 0, 0, 0, -20, 0))


@pytest.fixture
def server():
    """The address of a web server, and what was asked of it."""
    asked = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as service:
        threading.Thread(target=service.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{service.server_address[1]}", asked
        service.shutdown()


@pytest.mark.parametrize("relative", [0, 1])
def test_a_vrt_lists_rasters_of_this_machine(raster, tmp_path, relative):
    (tmp_path / "deeper").mkdir()
    name = "../dem.tif" if relative else raster
    vrt = write_vrt(tmp_path / "deeper/all.vrt", BAND.format(SOURCE.format(relative, name)))
    with rasters.open_raster(vrt) as dataset:
        np.testing.assert_array_equal(dataset.read(1).ravel(), np.arange(16))
    assert raster in [p.resolve() for p in files_named_in(vrt)]


def test_no_raster_asks_the_network(server, tmp_path):
    address, asked = server
    wms = (
        f'<GDAL_WMS><Service name="TMS"><ServerUrl>{address}/${{z}}</ServerUrl></Service><DataWindow><SizeX>4</SizeX>'
        "<SizeY>4</SizeY></DataWindow><BandsCount>1</BandsCount></GDAL_WMS>"
    )
    (tmp_path / "map.xml").write_text(wms)
    vrts = [
        BAND.format(SOURCE.format(0, f"/vsicurl/{address}/dem.tif")),
        BAND.format(SOURCE.format(0, f"{address}/dem.tif")),
        BAND.format(SOURCE.format(1, "map.xml")),
        BAND.format(SOURCE.format(1, "inner.vrt")),
        f'<Metadata domain="GEOLOCATION"><MDI key="X_DATASET">/vsicurl/{address}/x.tif</MDI></Metadata>',
    ]
    write_vrt(tmp_path / "inner.vrt", vrts[0])
    for inside in vrts:
        vrt = write_vrt(tmp_path / "all.vrt", inside)
        with pytest.raises(InputError, match=r"all\.vrt|inner\.vrt|map\.xml"), rasters.open_raster(vrt) as dataset:
            dataset.read(1)
        files_named_in(vrt)
    with pytest.raises(InputError, match=r"map.xml"), rasters.open_raster(tmp_path / "map.xml"):
        pass
    assert not asked


def test_gdal_is_kept_from_a_pipe_beside_a_raster(raster):
    """It would wait for ever for statistics in it."""
    os.mkfifo(raster.with_name("dem.tif.aux.xml"))
    with pytest.raises(InputError, match=r"found the device or pipe 'dem\.tif\.aux\.xml'"), rasters.open_raster(raster):
        pass


def test_a_vrt_has_no_raw_bands(tmp_path):
    for inside in (RAW, RAW.replace("VRTRasterBand", "vrtrasterband").replace("VRTRaw", "vrtRAW")):
        with (
            pytest.raises(InputError, match="found a raw band"),
            rasters.open_raster(write_vrt(tmp_path / "a.vrt", inside)),
        ):
            pass


def test_a_label_names_data_in_its_own_folder(tmp_path):
    """An ISIS label whose pixels lie elsewhere."""
    label = (
        "Object = IsisCube\n Object = Core\n  StartByte = 1\n  ^Core = {}\n  Format = BandSequential\n  Group = Dimensions\n"
        "   Samples = 4\n   Lines = 4\n   Bands = 1\n  End_Group\n  Group = Pixels\n   Type = UnsignedByte\n   ByteOrder = Lsb\n"
        "   Base = 0.0\n   Multiplier = 1.0\n  End_Group\n End_Object\nEnd_Object\nEnd\n"
    )
    inner = tmp_path / "inner"
    inner.mkdir()
    for place in (tmp_path, inner):
        (place / "secret.bin").write_bytes(b"0123456789abcdef")
    for name, good in (("secret.bin", True), ("../secret.bin", False), ("/etc/passwd", False)):
        (inner / "a.lbl").write_text(label.format(name))
        if good:
            with rasters.open_raster(inner / "a.lbl") as dataset:
                assert bytes(dataset.read(1).ravel()) == b"0123456789abcdef"
        else:
            with pytest.raises(InputError), rasters.open_raster(inner / "a.lbl"):
                pass


def view(path, name, source, inner):
    """Make a data set of a pairs file a view of another one."""
    with h5py.File(path, "r+") as file:
        shape, kept = file[name].shape, dict(file[name].attrs)
        del file[name]
        layout = h5py.VirtualLayout(shape, "f4")
        layout[...] = h5py.VirtualSource(source, inner, shape)
        data = file.create_virtual_dataset(name, layout)
        data.attrs["units"] = kept["units"]
    return path


def test_a_view_that_shows_itself_is_refused(tmp_path):
    """HDF5 follows it until the stack is full, and the process dies."""
    own = view(write_pairs(tmp_path / "own.h5"), "elevation", ".", "elevation")
    first = view(write_pairs(tmp_path / "first.h5"), "elevation", "second.h5", "elevation")
    view(write_pairs(tmp_path / "second.h5"), "elevation", "first.h5", "elevation")
    for path in (own, first):
        with pytest.raises(
            ArtefactError, match="/elevation: expected data, found a virtual data set that refers to itself"
        ):
            open_artefact(path, PAIRS)
        assert chain(path)[-1].record is None
        with pytest.raises(ArtefactError), rasters.open_raster(path):
            pass


def test_a_view_shows_files_beside_it(tmp_path):
    part = write_pairs(tmp_path / "inner/part.h5")
    whole = view(write_pairs(tmp_path / "whole.h5"), "elevation", "inner/part.h5", "elevation")
    with open_artefact(whole, PAIRS) as file:
        np.testing.assert_array_equal(file["elevation"][...].ravel(), np.arange(32))
    for name in (str(part), "../part.h5", "inner/../../part.h5"):
        shutil.copy(part, tmp_path.parent / "part.h5")
        view(whole, "elevation", name, "elevation")
        with pytest.raises(ArtefactError, match="/elevation: expected a view of files in its own folder"):
            open_artefact(whole, PAIRS)
    view(whole, "elevation", "inner/part.h5", "nothing")
    with pytest.raises(ArtefactError, match="expected the data set '/nothing'"):
        open_artefact(whole, PAIRS)


def test_a_damaged_byte_is_one_line(tmp_path):
    raw = write_pairs(tmp_path / "pairs.h5").read_bytes()
    refused = 0
    for place in range(0, len(raw), 389):
        (tmp_path / "damaged.h5").write_bytes(raw[:place] + bytes([raw[place] ^ 0x5A]) + raw[place + 1 :])
        try:
            open_artefact(tmp_path / "damaged.h5", PAIRS).close()
        except ArtefactError:
            refused += 1
    assert refused > 5


def test_names_that_lead_out_of_a_folder():
    assert all(map(is_inside, ("a.h5", "a/b.h5", "a/../b.h5", ".", "..a/b")))
    assert not any(map(is_inside, ("/a.h5", "../a.h5", "a/../../b.h5", "..")))
