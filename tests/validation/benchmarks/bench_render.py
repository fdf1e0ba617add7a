"""A 1024 x 1024 perspective view of a 4096 x 4096 DEM beside Mitsuba, views a second, and an ortho map streamed in blocks.

    python tests/validation/benchmarks/bench_render.py [--dem 4096] [--view 1024] [--map 4096]

Both draw the same scene with 2 x 2 rays a pixel, Lambert's law and cast shadows. Mitsuba's build (mesh and Embree-like
kd-tree or BVH) is timed apart from its rendering, because a trajectory over one DEM pays it once.
"""

from __future__ import annotations

import argparse
import math
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rasterio.transform import Affine

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "support"))

from relief import body_point, hills

from stages.physics.maps.geotiff import MapTiff
from stages.physics.maps.grid import Grid, local_metric_crs
from stages.physics.photometry import get_model
from stages.physics.terrain.shading import Light, shade_block
from stages.physics.terrain.sun import sun_from_angles
from stages.physics.terrain.sun_visibility import SunHorizon
from stages.physics.terrain.surface import Surface
from stages.render.grounds import Grounds
from stages.render.perspective import render_view
from stages.render.renderer import Renderer
from stages.render.scene import make_scene
from stages.render.viewpoint import look_at, pinhole_view

RADIUS, GSD, ALBEDO, FOV = 1737400.0, 5.0, 0.3, 20.0


def timed(work):
    """Result, wall seconds and CPU seconds of all threads: on a busy machine only the latter compare well."""
    start, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, np.array([time.perf_counter() - start, time.process_time() - cpu])


def ours(surface, camera, sun, relief):
    light = Light(sun, SunHorizon(surface.elevation, surface.grid, sun, relief[1] - relief[0]), None)
    scene = make_scene(Grounds(surface), camera, light, relief, 2)
    bands = list(render_view(surface, camera, light, scene))
    return np.concatenate([b["image"] for b in bands])


def build_peer(mi, grid, z, sun, folder):
    rows, cols = np.indices(z.shape)
    centre = body_point(grid, (grid.height - 1) / 2, (grid.width - 1) / 2, 0.0)
    # the projection of 16 million points is not what is compared: a tangent plane with curvature is as good here
    east, north = (cols - (grid.width - 1) / 2) * GSD, ((grid.height - 1) / 2 - rows) * GSD
    up = z - (east**2 + north**2) / (2 * RADIUS)
    axes = grid.local_frames((grid.height - 1) / 2, (grid.width - 1) / 2).axes[0]
    points = (np.stack([east, north, up], -1).reshape(-1, 3) @ axes / GSD).astype(np.float32)
    index = np.arange(z.size, dtype=np.uint32).reshape(z.shape)
    a, b, c, d = (v.ravel() for v in (index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]))

    def build():
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([c, b, d], 1)])
        mesh = mi.Mesh("terrain", len(points), len(faces), has_vertex_normals=True)
        params = mi.traverse(mesh)
        params["vertex_positions"] = points.ravel()
        params["faces"] = faces.ravel()
        params.update()
        path = folder / "terrain.ply"
        mesh.write_ply(str(path))
        return path

    path, mesh_seconds = timed(build)
    light = {
        "type": "directional",
        "direction": (-sun.directions(centre)).tolist(),
        "irradiance": {"type": "rgb", "value": math.pi},
    }
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}}
    terrain = {"type": "ply", "filename": str(path), "bsdf": bsdf}
    scene, load_seconds = timed(lambda: mi.load_dict({"type": "scene", "terrain": terrain, "sun": light}))
    return scene, centre, mesh_seconds, load_seconds


def peer_image(mi, scene, centre, camera):
    eye = (camera.centre - centre) / GSD
    forward, down = camera.rotation[:, 2], camera.rotation[:, 1]
    film = {
        "type": "hdrfilm",
        "width": camera.samples,
        "height": camera.lines,
        "rfilter": {"type": "box"},
        "pixel_format": "luminance",
    }
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": FOV,
            "far_clip": 1e7,
            "fov_axis": "x",
            "to_world": mi.ScalarTransform4f().look_at(
                origin=eye.tolist(), target=(eye + 1000 * forward).tolist(), up=(-down).tolist()
            ),
            "film": film,
            "sampler": {"type": "stratified", "sample_count": 4},
        }
    )
    integrator = mi.load_dict({"type": "direct", "hide_emitters": True})
    return np.array(mi.render(scene, sensor=sensor, integrator=integrator))[..., 0]


def views_per_second(surface):
    """A descent through the same Renderer, the Sun's horizon kept; wall and CPU seconds a view after the first."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "dem.tif"
        with MapTiff(path, surface.grid, ["elevation"], {}, ["m"]) as tif:
            tif.put(0, 0, surface.elevation[None])
        for rays in (1, 2):
            with Renderer(path, model="hapke", samples=rays) as renderer:
                for size in (512, 1024):
                    places = [(1 - 0.05 * k) * 0.3 * surface.grid.height * GSD for k in range(9)]
                    cameras = [descending(surface.grid, height, size) for height in places]
                    angle = {"sun_azimuth_deg": 120.0, "sun_elevation_deg": 25.0}
                    renderer.view(cameras[0], angle)
                    _, seconds = timed(lambda c=cameras, r=renderer, a=angle: [r.view(one, a) for one in c[1:]])
                    wall, cpu = seconds / (len(cameras) - 1)
                    print(f"{size} x {size}, {rays**2} rays a pixel: {1 / wall:.1f} views/s ({cpu:.2f} s CPU a view)")


def descending(grid, height, size):
    """A camera over the middle of a map that looks 30 deg ahead."""
    middle = grid.height / 2
    place = body_point(grid, middle, middle, height)
    ahead = body_point(grid, middle - 0.58 * height / GSD, middle, 0.0)
    return pinhole_view(place, look_at(place, ahead), 40.0, (size, size), RADIUS)


def _pair(values):
    return f"{values[0]:.2f} ({values[1]:.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dem", type=int, default=4096)
    parser.add_argument("--view", type=int, default=1024)
    parser.add_argument("--map", type=int, default=4096, help="rows and columns of the streamed ortho map")
    parser.add_argument("--no-peer", action="store_true")
    options = parser.parse_args()
    size = options.dem
    crs = local_metric_crs(10.0, 20.0, RADIUS)
    grid = Grid(crs.to_wkt(), Affine(GSD, 0, -size * GSD / 2, 0, -GSD, size * GSD / 2), size, size, RADIUS)
    z = hills(np.random.default_rng(1), size, GSD, 0.3)
    surface = Surface(Path("hills"), grid, z, get_model("lambert"), None, np.array([ALBEDO], np.float32))
    relief = (float(z.min()), float(z.max()))
    sun = sun_from_angles(120.0, 25.0, grid)
    half = size / 2
    reach = 0.5 * size * GSD / math.tan(math.radians(FOV / 2))
    views = {
        "nadir": ((half, half, 0.95 * reach), (half, half)),
        "oblique 60 deg": ((half + 0.35 * size, half, 0.2 * size * GSD), (half, half)),
    }
    warm = grid.window(0, 0, 128, 128)
    small = Surface(Path("hills"), warm, np.ascontiguousarray(z[:128, :128]), surface.model, None, surface.uniform)
    place = body_point(warm, 64, 64, 5000.0)
    ours(small, pinhole_view(place, look_at(place, body_point(warm, 64, 64, 0.0)), 5.0, (16, 16), RADIUS), sun, relief)
    peer = None
    if not options.no_peer:
        import mitsuba as mi

        mi.set_variant("scalar_rgb")
        with tempfile.TemporaryDirectory() as folder:
            peer, centre, mesh_seconds, load_seconds = build_peer(mi, grid, z, sun, Path(folder))
        print(
            f"Mitsuba {mi.__version__} scalar_rgb: mesh {mesh_seconds[0]:.1f} s, load and acceleration structure {load_seconds[0]:.1f} s"
        )
    print(
        f"{options.view} x {options.view} view of a {size} x {size} DEM, 2 x 2 rays a pixel, shadows; wall (CPU) seconds"
    )
    print(
        f"{'view':16s}{'lunargr, all':>16s}{'Mitsuba render':>18s}{'+ build':>18s}{'ratio with build':>20s}{'without':>16s}  I/F"
    )
    for name, (place, target) in views.items():
        position = body_point(grid, *place)
        rotation = look_at(position, body_point(grid, *target, 0.0))
        camera = pinhole_view(position, rotation, FOV, (options.view, options.view), RADIUS)
        image, seconds = timed(lambda camera=camera: ours(surface, camera, sun, relief))
        line = f"{name:16s}{_pair(seconds):>16s}"
        if peer is not None:
            theirs, render_seconds = timed(lambda camera=camera: peer_image(mi, peer, centre, camera))
            whole = mesh_seconds + load_seconds + render_seconds
            both = np.isfinite(image) & (theirs > 0)
            ratio, alone = whole / seconds, render_seconds / seconds
            line += f"{_pair(render_seconds):>18s}{_pair(whole):>18s}{_pair(ratio):>20s}{_pair(alone):>16s}"
            line += f"  {image[both].mean() / theirs[both].mean():.4f}"
        print(line)
    views_per_second(surface)
    rows = options.map
    light = Light(sun, SunHorizon(surface.elevation, grid, sun, relief[1] - relief[0]), None)
    shade_block(surface, light, 0, 0, 256, 256)
    done, start, cpu = 0, time.perf_counter(), time.process_time()
    for row in range(0, min(rows, size), 256):
        for col in range(0, min(rows, size), 1024):
            block = shade_block(surface, light, row, col, min(256, size - row), min(1024, size - col))
            done += block["image"].size
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    print(
        f"ortho, image and backplanes: {done / seconds / 1e6:.1f} Mpx/s ({cpu / done * 1e9:.0f} ns CPU a pixel); peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GiB"
    )


if __name__ == "__main__":
    main()
